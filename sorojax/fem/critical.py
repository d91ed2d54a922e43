"""Limit points and bifurcations between two states of a path."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.fem.arc_length import Loading, PathState, arc_step, tangent_state
from sorojax.fem.linear import Prepared
from sorojax.fem.modal import tangent_modes
from sorojax.fem.newton import Newton

_MAX_TRIALS = 12


class CriticalPoint(eqx.Module):
    """A state with a singular tangent, and the mode it is singular in (largest entry 1).

    `kind` is "limit point", where the load has a maximum or minimum, or "bifurcation",
    where another path crosses.
    """

    kind: str = eqx.field(static=True)
    factor: Float[Array, ""]
    displacement: Float[Array, "nodes dim"]
    shape: Float[Array, "nodes dim"]
    negative: int = eqx.field(static=True)


def locate(
    loading: Loading, prepared: Prepared, first: PathState, last: PathState, newton: Newton
) -> list[CriticalPoint]:
    """What lies between two neighbouring states: a limit point where the load turns, a
    bifurcation where the tangent loses or gains an eigenvalue otherwise."""
    turned = first.slope * last.slope < 0
    counts = first.negative_eigenvalues, last.negative_eigenvalues
    changes = abs(counts[1] - counts[0]) if min(counts) >= 0 else 0
    points = []
    if turned:
        points.append(_point("limit point", loading, prepared, (first, last), newton, _slope))
    if changes > turned:
        lower = min(counts)

        def stiffness(state: PathState) -> float:
            modes = tangent_modes(loading.at(state.factor), jnp.asarray(state.u), lower + 1)
            return float(modes.eigenvalues[lower])

        points.append(
            _point("bifurcation", loading, prepared, (first, last), newton, stiffness)
        )
    return [point for point in points if point is not None]


def _slope(state: PathState) -> float:
    return state.slope


def _point(
    kind: str,
    loading: Loading,
    prepared: Prepared,
    ends: tuple[PathState, PathState],
    newton: Newton,
    test: Callable[[PathState], float],
) -> CriticalPoint | None:
    """The zero of `test` along the path, by regula falsi with halved weights (Illinois)."""
    first, last = ends
    whole = float(np.sum(first.direction * (last.u - first.u)))
    at, values = [0.0, whole], [test(first), test(last)]
    goal = 1e-4 * max(abs(values[0]), abs(values[1]))
    # The update need not be small: along the mode rounding is amplified without bound.
    newton = Newton(newton.residual_tolerance, 1e-3, newton.max_iterations)
    state, best, side = None, np.inf, 0
    for _ in range(_MAX_TRIALS):
        s = (at[0] * values[1] - at[1] * values[0]) / (values[1] - values[0])
        # close to either end the step would be rounding
        s = float(np.clip(s, 1e-3 * whole, (1 - 1e-3) * whole))
        trial = _state_at(loading, prepared, first, s, newton)
        if trial is None:
            break
        value = test(trial)
        if abs(value) < best:
            state, best = trial, abs(value)
        if best <= goal:
            break
        k = 0 if value * values[0] > 0 else 1
        at[k], values[k] = s, value
        if side == k + 1:
            values[1 - k] /= 2
        side = k + 1
    if state is None:
        return None
    here = loading.at(state.factor)
    number = max(1, 1 + min(ends[0].negative_eigenvalues, ends[1].negative_eigenvalues))
    modes = tangent_modes(here, jnp.asarray(state.u), number)
    shape = modes.shapes[int(np.argmin(np.abs(modes.eigenvalues)))]
    return CriticalPoint(
        kind, jnp.asarray(state.factor), jnp.asarray(state.u),
        shape / jnp.max(jnp.abs(shape)), number - 1,
    )  # fmt: skip


def _state_at(loading, prepared, first: PathState, s: float, newton) -> PathState | None:
    found = arc_step(loading, prepared, first, s, newton)
    if found.reason:
        return None
    return tangent_state(
        loading, prepared, found.u, found.y[0], first.direction, found.linearised
    )
