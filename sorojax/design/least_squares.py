"""Levenberg-Marquardt within bounds, for residuals that solve equilibria on the host.

A library for traced functions would compile every experiment as one program with callbacks,
which no cache keeps, and takes no bounds; the residuals here are called as they are.

References:
    More, "The Levenberg-Marquardt algorithm: implementation and theory", Lecture Notes in
    Mathematics 630, 1978, for the scaling and the tests.
    Nielsen, "Damping parameter in Marquardt's method", IMM report 1999-05, for the damping.
    Kanzow, Yamashita, Fukushima, "Levenberg-Marquardt methods with strong local convergence
    properties for solving nonlinear equations with convex constraints", J. Comput. Appl.
    Math. 172, 2004, for the bounds.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax._types import real
from sorojax.math.status import Status

_LARGEST = 1e12  # damping at which no shorter step will help
_LEAST_GAIN = 1e-4  # share of the promised decrease that a step must bring


class Linearisation(NamedTuple):
    """Residual and its derivative at one point."""

    residual: Float[np.ndarray, " rows"]
    jacobian: Float[np.ndarray, "rows n"]

    @property
    def cost(self) -> float:
        """Half the sum of squares."""
        return float(self.residual @ self.residual) / 2

    @property
    def finite(self) -> bool:
        return bool(np.all(np.isfinite(self.residual)) and np.all(np.isfinite(self.jacobian)))


class Damping(eqx.Module):
    """What the method remembers: the damping, its growth at the next failure, and the
    largest length of each column of the Jacobian so far."""

    value: Float[Array, ""] = eqx.field(converter=real)
    growth: Float[Array, ""] = eqx.field(converter=real)
    scale: Float[Array, " n"] = eqx.field(converter=real)


class Box(NamedTuple):
    """Bounds; infinite where there are none."""

    lower: Float[np.ndarray, " n"]
    upper: Float[np.ndarray, " n"]

    def held(self, x, gradient) -> Bool[np.ndarray, " n"]:
        """Which variables lie at a bound that the gradient pushes them against."""
        return ((x <= self.lower) & (gradient > 0)) | ((x >= self.upper) & (gradient < 0))


class Tolerances(NamedTuple):
    """When to stop: relative decrease, largest change of a variable, and cosine between the
    residual and a column of the Jacobian."""

    decrease: float
    change: float
    cosine: float = 1e-10


class Iterate(NamedTuple):
    """A point that was accepted, the values there, and the memory to go on with."""

    count: int
    x: Float[np.ndarray, " n"]
    at: Linearisation
    damping: Damping
    change: float


def least_squares(
    evaluate: Callable[[np.ndarray], Linearisation | None],
    x: Float[np.ndarray, " n"],
    at: Linearisation,
    box: Box,
    tolerances: Tolerances,
    *,
    steps: range,
    damping: Damping | None = None,
    accepted: Callable[[Iterate], None] = lambda _: None,
) -> tuple[np.ndarray, Linearisation, Status]:
    """The point within `box` at which the sum of squares is least.

    Args:
        evaluate: Residual and Jacobian at a point; None where there are none.
        x: Where to begin, inside the box.
        at: What `evaluate` gives there.
        box: Bounds.
        tolerances: When to stop.
        steps: Numbers of the steps to take, each with one evaluation.
        damping: Of an earlier run that this one continues.
        accepted: Called with every accepted point.
    """
    lengths = np.linalg.norm(at.jacobian, axis=0)
    value, growth, scale = 1e-3, 2.0, lengths
    if damping is not None:
        value, growth = float(damping.value), float(damping.growth)
        scale = np.asarray(damping.scale)
    for k in steps:
        scale = np.maximum(scale, np.linalg.norm(at.jacobian, axis=0))
        weight = np.where(scale > 0, scale, 1.0)
        if _stationary(x, at, box, tolerances.cosine):
            return x, at, Status.successful
        step = step_within(at, x, box, value, weight)
        promised = at.cost - _model(at, step)
        small = np.max(np.abs(step)) <= tolerances.change
        if promised <= 1e-15 * at.cost or (small and value < 1):
            return x, at, Status.successful
        found = evaluate(x + step)
        gain = -1.0
        if found is not None and found.finite:
            gain = (at.cost - found.cost) / promised
        if gain < _LEAST_GAIN:
            value, growth = value * growth, 2 * growth
            if value > _LARGEST:
                return x, at, Status.not_converged
            continue
        assert found is not None
        decrease = 1 - found.cost / at.cost
        x, at = x + step, found
        value, growth = value * max(1 / 3, 1 - (2 * gain - 1) ** 3), 2.0
        accepted(
            Iterate(
                k + 1,
                x,
                at,
                Damping(real(value), real(growth), real(scale)),
                np.max(np.abs(step)),
            )
        )
        if decrease <= tolerances.decrease and promised <= tolerances.decrease * at.cost:
            return x, at, Status.successful
    return x, at, Status.max_steps


def step_within(
    at: Linearisation, x: np.ndarray, box: Box, damping: float, scale: np.ndarray
) -> Float[np.ndarray, " n"]:
    """The damped step; variables that it would push through a bound stop there, and the
    others are found anew with them held."""
    free = ~box.held(x, at.jacobian.T @ at.residual)
    step = np.zeros_like(x)
    while free.any():
        shift = at.residual + at.jacobian[:, ~free] @ step[~free]
        rows = np.concatenate([at.jacobian[:, free], np.diag(np.sqrt(damping) * scale[free])])
        goal = np.concatenate([-shift, np.zeros(free.sum())])
        step[free] = np.linalg.lstsq(rows, goal, rcond=None)[0]
        clipped = np.clip(x + step, box.lower, box.upper) - x
        out = free & (clipped != step) & ((x + step < box.lower) | (x + step > box.upper))
        step = np.where(out, clipped, step)
        if not out.any():
            break
        free &= ~out
    return step


def _model(at: Linearisation, step) -> float:
    left = at.residual + at.jacobian @ step
    return float(left @ left) / 2


def _stationary(x, at: Linearisation, box: Box, cosine: float) -> bool:
    gradient = at.jacobian.T @ at.residual
    free = ~box.held(x, gradient)
    size = np.linalg.norm(at.jacobian, axis=0) * np.linalg.norm(at.residual)
    return bool(np.all(np.abs(gradient[free]) <= cosine * size[free]))
