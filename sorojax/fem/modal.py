"""Small vibrations about an equilibrium, and motion reduced to a few of their modes."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._display import displayed, number
from sorojax._types import real
from sorojax.fem import spectrum
from sorojax.fem.linear import linearise, prepare
from sorojax.fem.mass import mass_matrix
from sorojax.fem.modal_slopes import differentiable
from sorojax.fem.problem import Problem
from sorojax.fem.supports import known_dofs
from sorojax.math import sparse


@displayed
class Modes(eqx.Module):
    """Shapes and eigenvalues about the equilibrium `displacement`, lowest first.

    Vibration modes have `eigenvalues` omega^2 [1/s^2] and shapes of unit modal mass;
    those of the tangent alone have the stiffness [N/m] and shapes of unit length. An
    unstable equilibrium has negative ones.
    """

    problem: Problem
    displacement: Float[Array, "nodes dim"]
    eigenvalues: Float[Array, " modes"]
    shapes: Float[Array, "modes nodes dim"]

    def __len__(self) -> int:
        return self.eigenvalues.shape[0]

    @property
    def frequencies(self) -> Float[Array, " modes"]:
        """omega / (2 pi) [Hz]; minus the rate of growth over 2 pi where unstable."""
        omega = jnp.sign(self.eigenvalues) * jnp.sqrt(jnp.abs(self.eigenvalues))
        return omega / (2 * jnp.pi)

    def _text(self) -> str:
        rows = (f"  {k + 1}: {number(f, 'Hz')}" for k, f in enumerate(self.frequencies))
        return "\n".join([f"Modes: {len(self)}", *rows])


def eigenmodes(
    problem: Problem, displacement: Float[Array, "nodes dim"] | None = None, count: int = 6
) -> Modes:
    """The lowest vibration modes about an equilibrium: K phi = omega^2 M phi.

    K is the tangent there, load stiffness included, and may be indefinite. Eigenvalues and
    shapes are differentiable in every number of the problem and in the displacement, so pass
    that of `fem.solve` for derivatives that see the equilibrium move; outside `jit`.

    Args:
        problem: The body with the loads that hold it there.
        displacement: The equilibrium [m]; at rest when omitted.
        count: Number of modes.

    Raises:
        ValueError: If the material has no density, or `count` is no possible number.
    """
    return _modes("fem.eigenmodes", problem, displacement, count, True)


def tangent_modes(
    problem: Problem, displacement: Float[Array, "nodes dim"] | None = None, count: int = 1
) -> Modes:
    """The lowest eigenvalues of the tangent stiffness [N/m]: the first one is positive at a
    stable equilibrium and vanishes at a critical point, whose mode it gives.

    Args:
        problem: The body with the loads that hold it there.
        displacement: The equilibrium [m]; at rest when omitted.
        count: Number of eigenvalues.

    Raises:
        ValueError: If `count` is no possible number.
    """
    return _modes("fem.tangent_modes", problem, displacement, count, False)


def _modes(where: str, problem: Problem, displacement, count: int, massive: bool) -> Modes:
    u = jnp.zeros_like(problem.mesh.points) if displacement is None else real(displacement)
    check_state(where, problem, u)
    known = known_dofs(problem.supports, *u.shape)
    free = int(np.sum(~known))
    if not 1 <= count <= free:
        raise ValueError(f"{where}: `count` is {count}, need 1 to {free}, the free unknowns.")

    def find(problem: Problem, u):
        mass = mass_matrix(problem) if massive else None
        values = linearise(problem, prepare(problem), u, u).values
        pencil = spectrum.pencil(problem.space.system, values, known, mass)
        eigenvalues, vectors = spectrum.lowest(pencil, count, mass)
        shapes = _signed(vectors.reshape(count, *u.shape))
        return jnp.asarray(eigenvalues), jnp.asarray(shapes)

    return Modes(problem, u, *differentiable(where, find, problem, u, massive))


def check_state(where: str, problem: Problem, u: Float[Array, "..."]) -> None:
    if u.shape != problem.mesh.points.shape:
        raise ValueError(
            f"{where}: `displacement` has shape {u.shape}, need {problem.mesh.points.shape}. "
            "Pass `solution.displacement` of the same mesh."
        )


def _signed(shapes: np.ndarray) -> np.ndarray:
    """Shapes whose largest entry is positive, so that a run repeats."""
    flat = shapes.reshape(len(shapes), -1)
    largest = np.take_along_axis(flat, np.abs(flat).argmax(axis=1)[:, None], axis=1)
    return (flat * np.sign(largest)).reshape(shapes.shape)


def expand(
    modes: Modes, coordinates: Float[Array, "... modes"]
) -> Float[Array, "... nodes dim"]:
    """Displacement [m] of modal coordinates q: u = u_0 + sum_k q_k phi_k."""
    moved = jnp.tensordot(real(coordinates), modes.shapes, axes=1)
    lead = (1,) * (moved.ndim - 2)
    return modes.displacement.reshape(*lead, *modes.displacement.shape) + moved


def modal_force(modes: Modes, force: Float[Array, "nodes dim"]) -> Float[Array, " modes"]:
    """Generalised force phi_k . f of a nodal force [N]; with unit modal mass the reduced
    motion is q'' + omega^2 q = phi . f."""
    return jnp.einsum("kni,ni->k", modes.shapes, real(force))


def modal_coordinates(
    modes: Modes, displacement: Float[Array, "nodes dim"]
) -> Float[Array, " modes"]:
    """Modal coordinates of a displacement: phi_k' M (u - u_0), for modes of `eigenmodes`."""
    system = modes.problem.space.system
    moved = (real(displacement) - modes.displacement).ravel()
    momentum = sparse.product(system, mass_matrix(modes.problem), moved)
    return modes.shapes.reshape(len(modes), -1) @ momentum
