r"""The damping of a rod, identified from its motion.

The equations of motion are tested with windows in time: over a window w that begins and ends
with weight zero,

    D \int w v dt = \int (w f + w' M v) dt,

where f holds all forces but damping. No acceleration of the samples is needed. D is the
symmetric positive semidefinite matrix that fits all windows best, one block for each strain.

Reference:
    Messenger and Bortz, Weak SINDy for partial differential equations, J. Comput. Phys. 443,
    2021, for tests with windows.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.jit import once
from sorojax._jax.trace_state import is_traced
from sorojax._types import real
from sorojax.rod import (
    AbstractDamping,
    Rod,
    inertia,
    motion,
    operators,
    stiffness_matrix,
    total_force,
)
from sorojax.rod.dynamics.dynamics import Forces
from sorojax.rod.model.basis import columns


class ConstantDamping(AbstractDamping):
    """Linear damping by a constant matrix, `coefficients` [N m s per coordinate rate]."""

    coefficients: Float[Array, "dof dof"] = eqx.field(converter=real)

    def matrix(self, stiffness):
        return self.coefficients


_FLAT = 8  # how flat a window ends; sums over samples are then as good as integrals
_SEEN = 1e-9  # least share of the motion at which a shape of the damping can be told


class DampingFit(eqx.Module):
    """Damping found in a motion.

    Attributes:
        damping: As a force on the rod.
        error: What it leaves unexplained of the force that damping must make [-].
    """

    damping: ConstantDamping
    error: Float[Array, ""]


def identify_damping(
    rod: Rod,
    t: Float[Array, " samples"],
    q: Float[Array, "samples dof"],
    forces: Forces = (),
    *,
    v: Float[Array, "samples dof"] | None = None,
    window: int = 21,
) -> DampingFit:
    """Damping matrix, a block per active strain, of a rod that was seen to move so.

    A free swing after a push will do, if it moves all coordinates. Coordinates of a FEM
    solution come from `strain_along` and `coordinates`.

    Args:
        rod: The rod, with its mass and stiffness.
        t: Equally spaced times [s], some twenty or more in a period of the fastest motion.
        q: Coordinates at these.
        forces: All forces on it but the damping; an elastic law replaces that of the rod.
        v: Rates [per s]; differences of order 4 if omitted.
        window: Samples in a window. More average noise away, up to about a period.

    Returns:
        The matrix as a force, and how well it explains the motion.

    Raises:
        ValueError: If times are not equally spaced, samples too few for a window, or a
            strain does not move in as many ways as it has coordinates.
    """
    times, states = np.asarray(t, float), real(q)
    _check.shape("identify_damping", "q", states, (len(times), rod.basis.num_dof), _ROWS)
    step = _step(times, window)
    rates = _differences(states, step) if v is None else real(v)
    _check.shape("identify_damping", "v", rates, states.shape, _ROWS)
    terms = _balance(rod, real(times), states, rates, forces)
    weights = _windows(len(times), window, step)
    matrix, error, least = _fitted(rod, rates, *terms, *weights)
    for name, share in least.items():
        if not is_traced(share) and not share > _SEEN:
            raise ValueError(
                f"identify_damping: the {rod.basis.modes[name].count} coordinates of `{name}` "
                "move in fewer ways than that, need all to move. Push the rod elsewhere or "
                "take fewer modes."
            )
    return DampingFit(ConstantDamping(matrix), error)


_ROWS = "Give one row of all coordinates for each time."


def _step(times: np.ndarray, window: int) -> float:
    if window < 5 or len(times) < 2 * window:
        raise ValueError(
            f"identify_damping: got {len(times)} samples and a window of {window}, need a "
            "window of 5 or more and twice its samples. Sample for longer or more often."
        )
    steps = np.diff(times)
    if not np.allclose(steps, steps.mean(), rtol=1e-3, atol=0) or steps.mean() <= 0:
        raise ValueError(
            f"identify_damping: got steps of {steps.min():.3g} to {steps.max():.3g} s between "
            "the samples, need equal ones. Interpolate to equally spaced times."
        )
    return float(steps.mean())


@once
def _balance(rod: Rod, t, q, v, forces) -> tuple[Array, Array]:
    """Momentum M v, and the force that changes it but for damping, of each sample."""
    constants = operators(rod)

    def at(t, q, v):
        moment = motion(rod, q, v, constants=constants)
        mass, coriolis = inertia(moment)

        def momentum(q):
            return inertia(motion(rod, q, constants=constants))[0] @ v

        _, growth = jax.jvp(momentum, (q,), (v,))
        return mass @ v, total_force(forces, t, moment) - coriolis + growth

    return jax.vmap(at)(t, q, v)


def _windows(samples: int, window: int, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows that integrate with the weight of each window, and with its slope in time."""
    half = (window - 1) / 2
    x = np.arange(window) / half - 1
    weight = step * (1 - x**2) ** _FLAT
    slope = -2 * _FLAT * x * (1 - x**2) ** (_FLAT - 1) / half
    starts = np.arange(0, samples - window + 1, max(1, window // 4))
    rows = np.zeros((2, len(starts), samples))
    for row, start in enumerate(starts):
        rows[:, row, start : start + window] = weight, slope
    return rows[0], rows[1]


@once
def _fitted(rod: Rod, rates, momentum, force, weight, slope):
    """The damping matrix, the share of the force that it leaves unexplained, and for each
    strain how little its coordinates move in one way over how much in another."""
    moved, lost = weight @ rates, weight @ force + slope @ momentum
    size = jnp.sqrt(jnp.diagonal(stiffness_matrix(rod)))  # forces and rates in one measure
    moved, lost = moved * size[None], lost / size[None]
    matrix, least = jnp.zeros((rod.basis.num_dof,) * 2), {}
    for name in rod.basis.active:
        at = columns(rod.basis, name)
        block, least[name] = _symmetric_fit(moved[:, at], lost[:, at])
        matrix = matrix.at[at, at].set(block)
    left = moved @ matrix - lost
    error = jnp.sqrt(jnp.sum(left**2) / jnp.sum(lost**2))
    return size[:, None] * matrix * size[None], error, least


def _symmetric_fit(x: Float[Array, "windows n"], b: Float[Array, "windows n"]):
    """The symmetric D of least |x D - b| without its negative part, from
    x'x D + D x'x = x'b + b'x, and the least singular value of x over the largest, squared."""
    n, squares = x.shape[1], x.T @ x
    right, eye = x.T @ b + b.T @ x, jnp.eye(x.shape[1])
    both = jnp.kron(squares, eye) + jnp.kron(eye, squares)
    found = jnp.linalg.solve(both, right.ravel()).reshape(n, n)
    values = jnp.linalg.eigvalsh(jax.lax.stop_gradient(squares))
    return positive_part((found + found.T) / 2), values[0] / values[-1]


@jax.custom_jvp
def positive_part(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The nearest positive semidefinite matrix of a symmetric one. Its derivative has no
    1 / (difference of eigenvalues), so that equal ones do no harm."""
    values, axes = jnp.linalg.eigh(matrix)
    return (axes * jnp.maximum(values, 0)[None]) @ axes.T


@positive_part.defjvp
def _positive_part_jvp(primals, tangents):
    (matrix,), (rate,) = primals, tangents
    values, axes = jnp.linalg.eigh(matrix)
    kept = jnp.maximum(values, 0)
    # divided differences of max(x, 0): 1 between positive, 0 between negative eigenvalues
    gap = jnp.abs(values)[:, None] + jnp.abs(values)[None]
    mixed = (kept[:, None] + kept[None]) / jnp.where(gap == 0, 1.0, gap)
    share = jnp.where(gap == 0, 1.0, mixed)
    inner = axes.T @ rate @ axes
    return (axes * kept[None]) @ axes.T, axes @ (share * inner) @ axes.T


def _differences(q: Float[Array, "samples dof"], step: float) -> Float[Array, "samples dof"]:
    """Slopes at the samples, of order 4, by five of them."""
    inner = (8 * (q[3:-1] - q[1:-3]) - (q[4:] - q[:-4])) / 12
    ends = np.array([[-25, 48, -36, 16, -3], [-3, -10, 18, -6, 1]]) / 12
    first, last = ends @ q[:5], -(ends @ q[:-6:-1])[::-1]
    return jnp.concatenate([first, inner, last]) / step
