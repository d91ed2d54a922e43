"""Parameters of any model from several experiments: Levenberg-Marquardt within bounds.

Residuals may solve equilibria on the host and are called as they are. A library for traced
functions would compile every experiment as one program with callbacks, which no cache keeps,
and takes no bounds.

References:
    More, "The Levenberg-Marquardt algorithm: implementation and theory", Lecture Notes in
    Mathematics 630, 1978, for the scaling and the tests.
    Nielsen, "Damping parameter in Marquardt's method", IMM report 1999-05, for the damping.
    Kanzow, Yamashita, Fukushima, "Levenberg-Marquardt methods with strong local convergence
    properties for solving nonlinear equations with convex constraints", J. Comput. Appl.
    Math. 172, 2004, for the bounds.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from sorojax import _check
from sorojax._progress import report
from sorojax._types import real
from sorojax.design.calibration.calibration import (
    Calibration,
    Experiment,
    compared,
    covariance_of,
    directions_of,
    evaluated,
    sensitivity,
    spectrum,
)
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
    """Memory of the method: the damping, its growth at the next failure, and the
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


# Parameters of any model from several experiments at once


class CalibrationStep(eqx.Module):
    """One step, as `on_step` sees it; also what `calibrate` starts again from.

    Attributes:
        count: Steps tried, from 1.
        parameters: After it.
        misfit: There, sum of squares of error over noise.
        change: Largest change of a scaled parameter.
        damping: Memory of the method.
    """

    count: int = eqx.field(static=True)
    parameters: PyTree
    misfit: Float[Array, ""]
    change: Float[Array, ""]
    damping: Damping


def calibrate(
    experiments: Sequence[Experiment],
    start: PyTree,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
    logarithmic: PyTree = True,
    hold_out: Sequence[Experiment] = (),
    steps: int = 50,
    tolerance: float = 1e-8,
    on_step: Callable[[CalibrationStep], None] | None = None,
    resume: CalibrationStep | None = None,
) -> Calibration:
    """The parameters whose predictions are nearest to all experiments, in units of the noise.

    min over p of sum ((predicted(p) - measured) / noise)^2 by Levenberg-Marquardt with exact
    derivatives: every experiment is solved once for a step, and all parameters share its
    factorisation. Trial parameters at which a model has no equilibrium count as a step that was
    too long. For tensile tables of a rubber `material.fit_tensile` is quicker, and says up to
    which stretch the fit is stable.

    Args:
        experiments: The records to fit.
        start: First guess, a pytree of floating-point arrays, in the units of the model.
        lower: Lower bounds, like `start`, with one number for each of its parts, or one number
            for all; none by default.
        upper: Upper bounds, in the same form.
        logarithmic: Which parameters are fitted by their logarithm: those that are positive
            and known to a factor only, such as moduli. A bool, or bools like `start`.
        hold_out: Further records, which are only predicted; none by default.
        steps: Most steps, each with one evaluation of every experiment.
        tolerance: Relative decrease of the misfit, and largest change of a scaled parameter,
            at which to stop [-].
        on_step: Called after every accepted step: progress, checkpoints. Nothing by default.
        resume: A step to go on from instead of `start`.

    Returns:
        Parameters, their covariance, and the experiments beside their predictions.

    Raises:
        ValueError: If a prediction is not finite or has another shape than its record, or a
            first guess lies outside its bounds or is not positive where it has to be.

    Example:
        >>> time = jnp.linspace(0.0, 1.0, 5)
        >>> decay = design.Experiment(lambda rate: jnp.exp(-rate * time), jnp.exp(-2 * time),
        ...                           noise=0.01)
        >>> found = design.calibrate([decay], jnp.array(1.0))
        >>> print(f"{float(found.parameters):.3f} +- {float(found.standard_errors):.3f} 1/s")
        2.000 +- 0.031 1/s

    Reference:
        More, The Levenberg-Marquardt algorithm: implementation and theory, Lecture Notes in
        Mathematics 630, 1978; Seber and Wild, Nonlinear Regression, 1989, for the covariance.
    """
    experiments = tuple(experiments)
    if not experiments:
        raise ValueError("calibrate: got no experiment, need at least one. List records.")
    task = _task(experiments, start, lower, upper, logarithmic)
    x, first, damping = task.x, 0, None
    if resume is not None:
        x = task.scaled(ravel_pytree(resume.parameters)[0])
        first, damping = resume.count, resume.damping
    at = task.linearised(x)
    _need_finite(task, at)
    history, last = [], resume

    tried = first

    def evaluate(x):
        nonlocal tried
        tried += 1
        found = evaluated(lambda: task.linearised(x))
        misfit = np.nan if found is None else 2 * found.cost
        report("calibrate", tried, steps, misfit=misfit)
        return found

    def accepted(step: Iterate):
        nonlocal last
        last = CalibrationStep(
            step.count,
            task.parameters(step.x),
            jnp.asarray(2 * step.at.cost),
            jnp.asarray(step.change),
            step.damping,
        )
        history.append((2 * step.at.cost, float(step.change)))
        if on_step is not None:
            on_step(last)

    x, at, status = least_squares(
        evaluate,
        x,
        at,
        task.box,
        Tolerances(tolerance, tolerance),
        steps=range(first, steps),
        damping=damping,
        accepted=accepted,
    )
    free = ~task.box.held(x, at.jacobian.T @ at.residual)
    values, rows = spectrum(at.jacobian, free)
    slope = task.slopes(x)
    with np.errstate(invalid="ignore"):
        covariance = slope[:, None] * covariance_of(values, rows) * slope[None]
    parameters = task.parameters(x)
    columns = list(zip(*history, strict=True)) or [(), ()]
    return Calibration(
        parameters,
        status,
        covariance,
        2 * at.cost,
        len(at.residual) - int(free.sum()),
        task.names,
        task.logarithmic,
        (x <= task.box.lower) | (x >= task.box.upper),
        values,
        rows,
        tuple(compared(e, parameters, covariance) for e in experiments),
        tuple(compared(e, parameters, covariance) for e in hold_out),
        {"misfit": np.array(columns[0]), "change": np.array(columns[1])},
        last,
    )


class _Task(NamedTuple):
    """The experiments over scaled parameters: logarithms, and others over their size."""

    experiments: tuple[Experiment, ...]
    like: PyTree
    x: Float[np.ndarray, " n"]
    box: Box
    logarithmic: np.ndarray
    size: Float[np.ndarray, " n"]
    names: tuple[str, ...]

    def scaled(self, flat) -> np.ndarray:
        return _scaled(np.asarray(flat), self.logarithmic, self.size)

    def flat(self, x) -> np.ndarray:
        return np.where(
            self.logarithmic, np.exp(np.where(self.logarithmic, x, 0.0)), x * self.size
        )

    def slopes(self, x) -> np.ndarray:
        """dp/dx of every parameter."""
        return np.where(self.logarithmic, self.flat(x), self.size)

    def parameters(self, x) -> PyTree:
        return jax.tree.map(lambda leaf: leaf[0], directions_of(self.like, self.flat(x)[None]))

    def linearised(self, x) -> Linearisation:
        parameters = self.parameters(x)
        directions = directions_of(parameters, np.diag(self.slopes(x)))
        found = [sensitivity(e, parameters, directions) for e in self.experiments]
        residual, jacobian = (np.concatenate(part) for part in zip(*found, strict=True))
        return Linearisation(residual, jacobian)


def _task(experiments, start, lower, upper, logarithmic) -> _Task:
    like = jax.tree.map(real, start)
    p = np.asarray(ravel_pytree(like)[0], float)
    _check.finite("calibrate", "start", p, "Check the first guess.")
    log = _flat("logarithmic", logarithmic, like, False) > 0
    low, high = _flat("lower", lower, like, -np.inf), _flat("upper", upper, like, np.inf)
    names = _names(like)
    outside = ~((low <= p) & (p <= high)) | ~(low < high)
    if outside.any():
        k = int(np.flatnonzero(outside)[0])
        raise ValueError(
            f"calibrate: `{names[k]}` starts at {p[k]:g}, its bounds are {low[k]:g} and "
            f"{high[k]:g}. Start between the bounds, the lower one first."
        )
    if np.any(p[log] <= 0):
        k = int(np.flatnonzero(log & (p <= 0))[0])
        raise ValueError(
            f"calibrate: `{names[k]}` starts at {p[k]:g}, need a positive number for its "
            "logarithm. Start above zero, or pass logarithmic=False for it."
        )
    span = np.where(np.isfinite(high - low), high - low, 1.0)
    size = np.where(p != 0, np.abs(p), span)
    with np.errstate(divide="ignore"):
        low = _scaled(np.where(log, np.maximum(low, 0.0), low), log, size)
        box = Box(low, _scaled(high, log, size))
    return _Task(experiments, like, _scaled(p, log, size), box, log, size, names)


def _scaled(p, logarithmic, size) -> np.ndarray:
    return np.where(logarithmic, np.log(np.where(logarithmic, p, 1.0)), p / size)


def _flat(name: str, given, like, default) -> np.ndarray:
    """`given` for every number of `like`: a number for all, or one for each part."""
    if given is None:
        given = default
    if jax.tree.structure(given) == jax.tree.structure(0):
        given = jax.tree.map(lambda _: given, like)
    try:
        whole = jax.tree.map(
            lambda leaf, g: np.broadcast_to(np.asarray(g, float), leaf.shape), like, given
        )
    except ValueError as error:
        raise ValueError(
            f"calibrate: `{name}` does not fit `start` ({error}). Give one number, or a tree "
            "like it."
        ) from None
    return np.concatenate([np.zeros(0), *(np.ravel(x) for x in jax.tree.leaves(whole))])


def _names(like: PyTree) -> tuple[str, ...]:
    names = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(like)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator=".") or "parameter"
        places = np.ndindex(leaf.shape)
        names += [name + "".join(f"[{i}]" for i in place) for place in places]
    return tuple(names)


def _need_finite(task: _Task, at: Linearisation) -> None:
    if at.finite:
        return
    what = "prediction" if not np.all(np.isfinite(at.residual)) else "derivative"
    raise ValueError(
        f"calibrate: a {what} is not finite at the first guess. Start where every experiment "
        "has an answer, or mark one without forward derivatives as not differentiable."
    )
