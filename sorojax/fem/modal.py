"""Small vibrations about an equilibrium, and motion reduced to a few of their modes."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.fem import spectrum
from sorojax.fem.linear import linearise, prepare
from sorojax.fem.mass import mass_matrix
from sorojax.fem.problem import Problem
from sorojax.math import sparse


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


def eigenmodes(
    problem: Problem, displacement: Float[Array, "nodes dim"] | None = None, count: int = 6
) -> Modes:
    """The lowest vibration modes about an equilibrium: K phi = omega^2 M phi.

    K is the tangent there, load stiffness included, and may be indefinite.

    Args:
        problem: The body with the loads that hold it there.
        displacement: The equilibrium [m]; at rest when omitted.
        count: Number of modes.

    Raises:
        ValueError: If the material has no density, or `count` is no possible number.
    """
    return _modes(
        "fem.eigenmodes", problem, displacement, count, np.asarray(mass_matrix(problem))
    )


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
    return _modes("fem.tangent_modes", problem, displacement, count, None)


def _modes(where: str, problem: Problem, displacement, count: int, mass) -> Modes:
    u = jnp.zeros_like(problem.mesh.points) if displacement is None else real(displacement)
    check_state(where, problem, u)
    prepared = prepare(problem)
    known = np.asarray(prepared.known)
    free = int(np.sum(~known))
    if not 1 <= count <= free:
        raise ValueError(f"{where}: `count` is {count}, need 1 to {free}, the free unknowns.")
    values = linearise(problem, prepared, u, u).values
    pencil = spectrum.pencil(problem.space.system, values, known, mass)
    eigenvalues, vectors = spectrum.lowest(pencil, count, mass)
    shapes = vectors.reshape(count, *u.shape)
    return Modes(problem, u, jnp.asarray(eigenvalues), jnp.asarray(_signed(shapes)))


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
