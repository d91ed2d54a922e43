"""The damping of a rod, identified from its motion.

The equations of motion are tested with windows in time: over a window that begins and ends
with weight zero,

    D \\int w v dt = \\int (w f + w' M v) dt,

where f holds all forces but damping. No acceleration of the samples is needed. D is the
symmetric matrix that fits all windows best, one block for each strain, without the part that
would add energy.

Reference:
    Messenger and Bortz, Weak SINDy for partial differential equations, J. Comput. Phys. 443,
    2021, for tests with windows.
"""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.reduction.identify import ConstantDamping
from sorojax.rod import Rod, inertia, motion, operators, stiffness_matrix, total_force
from sorojax.rod.basis import columns
from sorojax.rod.dynamics import Forces

_FLAT = 8  # how flat a window ends; sums over samples are then as good as integrals
_SEEN = 1e-9  # least share of the motion at which a shape of the damping can be told


class DampingFit(eqx.Module):
    """Damping found in a motion.

    Attributes:
        damping: As a force on the rod.
        error: What it leaves unexplained of the force that damping must make [-].
    """

    damping: ConstantDamping
    error: float


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

    Raises:
        ValueError: If times are not equally spaced, samples too few for a window, or a
            strain does not move in as many ways as it has coordinates.
    """
    times, states = np.asarray(t, float), np.asarray(q, float)
    _check.shape("identify_damping", "q", states, (len(times), rod.basis.num_dof), _ROWS)
    step = _step(times, window)
    rates = _differences(states, step) if v is None else np.asarray(v, float)
    _check.shape("identify_damping", "v", rates, states.shape, _ROWS)
    terms = _balance(rod, real(times), real(states), real(rates), forces)
    stiffness = np.diag(np.asarray(stiffness_matrix(rod)))
    momentum, force = (np.asarray(term) for term in terms)
    weight, slope = _windows(len(times), window, step)
    moved, lost = weight @ rates, weight @ force + slope @ momentum
    size = np.sqrt(stiffness)  # forces and rates of all coordinates in one measure
    moved, lost = moved * size, lost / size
    matrix = np.zeros((rod.basis.num_dof,) * 2)
    for name in rod.basis.active:
        at = columns(rod.basis, name)
        matrix[at, at] = _symmetric_fit(name, moved[:, at], lost[:, at])
    left = np.linalg.norm(moved @ matrix - lost) / np.linalg.norm(lost)
    return DampingFit(ConstantDamping(size[:, None] * matrix * size), float(left))


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


@eqx.filter_jit
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


def _symmetric_fit(name: str, x: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The symmetric D of least |x D - b| without its negative part."""
    squares, axes = np.linalg.eigh(x.T @ x)
    if not squares[0] > _SEEN * squares[-1]:
        raise ValueError(
            f"identify_damping: the {len(squares)} coordinates of `{name}` move in fewer ways "
            "than that, need all to move. Push the rod elsewhere or take fewer modes."
        )
    both = axes.T @ (x.T @ b + b.T @ x) @ axes
    found = axes @ (both / (squares[:, None] + squares)) @ axes.T
    values, directions = np.linalg.eigh(found)
    return (directions * np.maximum(values, 0)) @ directions.T


def _differences(q: np.ndarray, step: float) -> np.ndarray:
    """Slopes at the samples, of order 4, by five of them."""
    v = np.empty_like(q)
    v[2:-2] = (8 * (q[3:-1] - q[1:-3]) - (q[4:] - q[:-4])) / 12
    ends = np.array([[-25, 48, -36, 16, -3], [-3, -10, 18, -6, 1]]) / 12
    v[:2] = ends @ q[:5]
    v[-2:] = -(ends @ q[:-6:-1])[::-1]
    return v / step
