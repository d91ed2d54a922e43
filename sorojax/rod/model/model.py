"""Functions of a rod or an assembly, which choose between the two when a program is traced."""

from typing import TypeAlias, overload

from jaxtyping import Array, Float

from sorojax.math.compiled import full_products
from sorojax.rod.dynamics.fields import Operators, RodState, operators as rod_operators
from sorojax.rod.dynamics.tree import (
    AssemblyOperators,
    AssemblyState,
    assembly_inertia,
    assembly_motion,
    assembly_operators,
    rod_inertia,
    rod_motion,
)
from sorojax.rod.model.assembly import Assembly
from sorojax.rod.model.rod import Rod

Model: TypeAlias = Rod | Assembly


@overload
def operators(model: Rod) -> Operators: ...
@overload
def operators(model: Assembly) -> AssemblyOperators: ...
@full_products
def operators(model: Rod | Assembly):
    """The arrays of a model that do not depend on its coordinates: stiffness, mass per length,
    values of the strain basis and integration weights at the Gauss nodes.

    Loops compute them once and hand them to `motion`; all other functions of this package do so
    by themselves. Differentiable in the numbers of the model.

    Args:
        model: The rod or assembly.

    Returns:
        `Operators` of a rod, `AssemblyOperators` of an assembly.

    Example:
        >>> finger = rod.rod(SE2(), rod.chebyshev(kappa_z=3), rod.circle(5 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> stiffness = rod.operators(finger).stiffness  # E I L of the constant mode
        >>> print(f"{float(stiffness[0, 0]):.2e} N m^3")
        4.91e-05 N m^3
    """
    return rod_operators(model) if isinstance(model, Rod) else assembly_operators(model)


@overload
def motion(model: Rod, q: Array, v: Array | None = None, *, constants=None) -> RodState: ...
@overload
def motion(
    model: Assembly, q: Array, v: Array | None = None, *, constants=None
) -> AssemblyState: ...
@full_products
def motion(
    model: Rod | Assembly,
    q: Float[Array, " coordinates"],
    v: Float[Array, " dof"] | None = None,
    *,
    constants=None,
):
    """The fields of a model at (q, v), which forces and inertia read.

    Args:
        model: The rod or assembly.
        q: Coordinates.
        v: Their rates; zero if omitted.
        constants: `operators(model)`, if a loop has them already.

    Returns:
        A `RodState`, or an `AssemblyState` of an assembly; what is not read of it is not
        computed.
    """
    if isinstance(model, Assembly):
        return assembly_motion(model, q, v, constants)
    return rod_motion(model, q, v, constants)


@full_products
def inertia(
    moment: RodState | AssemblyState,
) -> tuple[Float[Array, "dof dof"], Float[Array, " dof"]]:
    """Mass matrix and Coriolis force of a moment.

    Args:
        moment: State of the model, from `motion`.

    Returns:
        The mass matrix M(q), and the force C(q, v) v.
    """
    if isinstance(moment, AssemblyState):
        return assembly_inertia(moment)
    return rod_inertia(moment)
