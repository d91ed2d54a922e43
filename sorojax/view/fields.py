"""Values to colour a body by: fields known by name, functions and arrays."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import fem
from sorojax.fem import Problem
from sorojax.mesh import cell_areas, cell_volumes
from sorojax.view.quantity import Coloured

NodalField = Callable[[Problem, Float[Array, "nodes dim"]], Float[Array, " nodes"]]
Field = str | NodalField | Float[Any, " values"] | None


@eqx.filter_jit
def nodal_von_mises(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, " nodes"]:
    """Von Mises stress at the nodes, averaged between cells [kPa]."""
    return fem.nodal_average(problem, fem.von_mises_stress(problem, u)) / 1e3


@eqx.filter_jit
def _mean_stress(problem: Problem, u) -> Float[Array, " nodes"]:
    sigma = fem.cauchy_stress(problem, u)
    return fem.nodal_average(problem, jnp.trace(sigma, axis1=-2, axis2=-1) / 3)


@eqx.filter_jit
def _largest_stretch(problem: Problem, u) -> Float[Array, " nodes"]:
    F = fem.deformation_gradient(problem, u)
    C = jnp.swapaxes(F, -1, -2) @ F
    return fem.nodal_average(problem, jnp.sqrt(jnp.linalg.eigvalsh(C)[..., -1]))


def _energy_density(problem: Problem, u) -> Float[np.ndarray, " cells"]:
    mesh = problem.mesh
    size = cell_areas(mesh) if mesh.element.dim == 2 else cell_volumes(mesh)
    depth = getattr(problem.kinematics, "thickness", 1.0)
    return np.asarray(fem.strain_energy(problem, u)) / np.asarray(size * depth)


_NAMED: dict[str, tuple[str, str, Callable[..., Any]]] = {
    "von_mises": ("von Mises stress", "Pa", lambda p, u: 1e3 * nodal_von_mises(p, u)),
    "pressure": ("mean stress", "Pa", _mean_stress),
    "displacement": ("displacement", "m", lambda p, u: jnp.sqrt(jnp.sum(u**2, axis=1))),
    "x": ("displacement along x", "m", lambda p, u: u[:, 0]),
    "y": ("displacement along y", "m", lambda p, u: u[:, 1]),
    "z": ("displacement along z", "m", lambda p, u: u[:, 2]),
    "stretch": ("largest stretch", "-", _largest_stretch),
    "energy": ("strain energy density", "J/m^3", _energy_density),
}


def evaluate(
    problem: Problem, u: Float[Array, "nodes dim"], field: Field, label: str = ""
) -> Coloured | None:
    """The field of a body at displacement `u` [m].

    Args:
        problem: The body.
        u: Displacement of its nodes.
        field: "von_mises", "pressure" (mean stress, tension positive), "displacement", "x",
            "y", "z", "stretch", "energy"; `field(problem, u)` or an array, one value per
            node or per cell; None for no field.
        label: Name and unit of a function or an array.

    Raises:
        ValueError: If there is no field of that name.
    """
    if field is None:
        return None
    if isinstance(field, str):
        if field not in _NAMED:
            raise ValueError(
                f"view: got field={field!r}, need one of {', '.join(_NAMED)}, a function of "
                "(problem, u), or an array."
            )
        name, unit, function = _NAMED[field]
        return Coloured(np.asarray(function(problem, u)), label or name, "" if label else unit)
    values = field(problem, u) if callable(field) else field
    return Coloured(np.asarray(values), label, "")
