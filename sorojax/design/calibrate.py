"""Parameters of any model from several experiments at once."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from sorojax import _check
from sorojax._progress import report
from sorojax._types import real
from sorojax.design.calibration import (
    Calibration,
    compared,
    covariance_of,
    spectrum,
)
from sorojax.design.experiment import Experiment, directions_of, evaluated, sensitivity
from sorojax.design.least_squares import (
    Box,
    Damping,
    Iterate,
    Linearisation,
    Tolerances,
    least_squares,
)


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
    """The parameters whose predictions lie nearest to all experiments, in units of the noise.

    Levenberg-Marquardt with exact derivatives: every experiment is solved once for a step,
    and all parameters share its factorisation. Trial parameters at which a model has no
    equilibrium count as a step that was too long. For tensile tables of a rubber
    `material.fit_tensile` is quicker, and tells up to which stretch the fit is stable.

    Args:
        experiments: The records to fit.
        start: First guess, a pytree of floating-point arrays.
        lower, upper: Bounds, like `start`, with one number for each of its parts, or one
            number for all.
        logarithmic: Which parameters are fitted by their logarithm: those that are positive
            and known to a factor only, such as moduli. A bool, or bools like `start`.
        hold_out: Further records, which are only predicted.
        steps: Most steps, each with one evaluation of every experiment.
        tolerance: Relative decrease of the misfit, and largest change of a scaled parameter,
            at which to stop.
        on_step: Called after every accepted step: progress, checkpoints.
        resume: A step to go on from instead of `start`.

    Raises:
        ValueError: If a prediction is not finite or has another shape than its record, or a
            first guess lies outside its bounds or is not positive where it has to be.
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
            step.count, task.parameters(step.x), jnp.asarray(2 * step.at.cost),
            jnp.asarray(step.change), step.damping,
        )  # fmt: skip
        history.append((2 * step.at.cost, float(step.change)))
        if on_step is not None:
            on_step(last)

    x, at, status = least_squares(
        evaluate, x, at, task.box, Tolerances(tolerance, tolerance),
        steps=range(first, steps), damping=damping, accepted=accepted,
    )  # fmt: skip
    free = ~task.box.held(x, at.jacobian.T @ at.residual)
    values, rows = spectrum(at.jacobian, free)
    slope = task.slopes(x)
    with np.errstate(invalid="ignore"):
        covariance = slope[:, None] * covariance_of(values, rows) * slope[None]
    parameters = task.parameters(x)
    columns = list(zip(*history, strict=True)) or [(), ()]
    return Calibration(
        parameters, status, covariance, 2 * at.cost, len(at.residual) - int(free.sum()),
        task.names, task.logarithmic, (x <= task.box.lower) | (x >= task.box.upper),
        values, rows, tuple(compared(e, parameters, covariance) for e in experiments),
        tuple(compared(e, parameters, covariance) for e in hold_out),
        {"misfit": np.array(columns[0]), "change": np.array(columns[1])}, last,
    )  # fmt: skip


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
