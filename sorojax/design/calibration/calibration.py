"""Experiments (what was measured, how accurately, and what a model predicts), and the result
of a calibration: parameters, their uncertainty, and the combinations that no reading
determines.

Uncertainties are those of the linearised model: with the noise n_i of every reading and
r_i = (predicted - measured) / n_i the covariance is (J'J)^-1 for J = dr/dp.

Reference: Seber & Wild, Nonlinear Regression, 1989, chapters 2 and 5.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from sorojax import _check
from sorojax._types import real
from sorojax.fem import ConvergenceError, MotionError
from sorojax.math.status import Status

Answer = TypeVar("Answer")
_STEP = 6e-6  # cube root of the spacing of float64, for central differences


class Experiment(eqx.Module):
    """One record and the function that predicts it.

    Attributes:
        predict: From parameters to an array like `measured`. It is called as it is, so it may
            solve equilibria, paths and motions; jit it where it can be. Motions of
            `systems.simulate` need `adjoint=diffrax.ForwardMode()`.
        measured: Readings, NaN where a sensor gave none.
        noise: Standard deviation of each reading in its unit: a number, or an array that
            broadcasts to `measured`, such as one number per sensor.
        name: For reports.
        differentiable: Whether `predict` has forward derivatives; if not, central
            differences take two calls for every parameter.
    """

    predict: Callable[[PyTree], Float[Array, "..."]]
    measured: Float[Array, "..."] = eqx.field(converter=real)
    noise: Float[Array, "..."] = eqx.field(converter=real)
    name: str = eqx.field(static=True, default="experiment")
    differentiable: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        where = f"Experiment `{self.name}`"
        _check.positive(where, "noise", self.noise, "", "Give the scatter of repeats.")
        try:
            np.broadcast_to(self.noise, self.measured.shape)
        except ValueError:
            raise ValueError(
                f"{where}: `noise` has shape {self.noise.shape}, need one that broadcasts to "
                f"that of `measured`, {self.measured.shape}. Give a number, or one per sensor."
            ) from None
        if not np.any(self.read):
            raise ValueError(f"{where}: got no reading, need at least one. Drop the record.")

    @property
    def read(self) -> np.ndarray:
        """Where there are readings."""
        return np.isfinite(np.asarray(self.measured))

    def errors(self, predicted) -> Float[np.ndarray, " readings"]:
        """Predicted minus measured in units of the noise, of all readings."""
        gap = np.asarray(predicted) - np.asarray(self.measured)
        return (gap / np.broadcast_to(self.noise, gap.shape))[self.read]


def predicted(experiment: Experiment, parameters: PyTree) -> Float[np.ndarray, "..."]:
    """The prediction of the model.

    Raises:
        ValueError: If it has another shape than what was measured.
    """
    value = np.asarray(experiment.predict(parameters))
    _need_shape(experiment, value.shape)
    return value


def sensitivity(
    experiment: Experiment, parameters: PyTree, directions: PyTree
) -> tuple[np.ndarray, np.ndarray]:
    """Errors in units of the noise, and how they move along `directions`, a tree like the
    parameters with one leading axis: (readings,) and (readings, directions).

    All directions share one solve: each is a back-substitution with its factor.
    """
    if experiment.differentiable:
        push = _pushed_once if hasattr(experiment.predict, "lower") else _pushed
        value, moved = push(experiment.predict, parameters, directions)
        value, moved = np.asarray(value[0]), np.asarray(moved)
        _need_shape(experiment, value.shape)
    else:
        value = predicted(experiment, parameters)
        moved = _differences(experiment, parameters, directions)
    noise = np.broadcast_to(experiment.noise, value.shape)
    columns = moved / noise
    return experiment.errors(value), columns[:, experiment.read].T


def evaluated(function: Callable[[], Answer]) -> Answer | None:
    """Value of `function`, None where the model has no equilibrium or motion."""
    try:
        return function()
    except (ConvergenceError, MotionError):
        return None


def _pushed(predict, parameters, directions):
    def along(dot):
        return jax.jvp(predict, (parameters,), (dot,))

    return jax.vmap(along)(directions)


_pushed_once = functools.partial(jax.jit, static_argnums=0)(_pushed)


def _differences(experiment: Experiment, parameters, directions) -> np.ndarray:
    count = jax.tree.leaves(directions)[0].shape[0]
    rows = []
    for k in range(count):
        ends = [
            predicted(
                experiment,
                jax.tree.map(
                    lambda p, d, s=s, k=k: p + s * _STEP * d[k], parameters, directions
                ),
            )
            for s in (1, -1)
        ]
        rows.append((ends[0] - ends[1]) / (2 * _STEP))
    return np.stack(rows)


def _need_shape(experiment: Experiment, shape: tuple) -> None:
    if shape != experiment.measured.shape:
        raise ValueError(
            f"calibrate: experiment `{experiment.name}` predicts an array of shape {shape}, "
            f"need {experiment.measured.shape}, that of `measured`. Stack the readings alike."
        )


def directions_of(parameters: PyTree, rows: Float[np.ndarray, "directions n"]) -> PyTree:
    """Rows of flat directions as a tree like the parameters with a leading axis."""
    leaves, tree = jax.tree.flatten(parameters)
    ends = np.cumsum([leaf.size for leaf in leaves])[:-1]
    parts = [
        jnp.asarray(part.reshape(-1, *leaf.shape), leaf.dtype)
        for part, leaf in zip(np.split(rows, ends, axis=1), leaves, strict=True)
    ]
    return jax.tree.unflatten(tree, parts)


# What a calibration found: parameters, how well they are known, and what was not seen


_BLIND = 1e-7  # of the largest singular value: below it a combination moves nothing
_SHARE = 0.05  # of a unit vector: parameters that are named in a combination


class Check(NamedTuple):
    """One experiment beside its prediction.

    Attributes:
        name: Of the experiment.
        predicted: Like what was measured.
        error: Predicted minus measured, NaN where there is no reading.
        rms: Root mean square of error over noise; about 1 for a model that is right.
        expected: Standard deviation of the prediction by what the parameters are known to.
    """

    name: str
    predicted: Float[np.ndarray, "..."]
    error: Float[np.ndarray, "..."]
    rms: float
    expected: Float[np.ndarray, "..."]

    def __str__(self) -> str:
        worst = np.nanmax(np.abs(self.error))
        return f"{self.name}: {self.rms:.2g} times the noise, largest error {worst:.3g}"


class Combination(NamedTuple):
    """A combination of parameters, and how well the experiments see it.

    Attributes:
        weights: By parameter; of the logarithm of a logarithmic one, otherwise of the
            parameter over its first guess. Small ones are left out.
        deviation: Standard deviation of the combination, infinite where nothing moves.
    """

    weights: dict[str, float]
    deviation: float

    def __str__(self) -> str:
        terms = " ".join(f"{w:+.2f} {name}" for name, w in self.weights.items())
        return f"{terms}: known to {self.deviation:.2g}"


class Calibration(eqx.Module):
    """Fitted parameters and what is known of them.

    Attributes:
        parameters: Like the first guess.
        status: `successful`; `max_steps`; `not_converged` where no shorter step helped.
        covariance: Of the flat parameters in their units, by the stated noise. Infinite for
            parameters that no reading sees alone; zero for those that lie at a bound and are
            held there.
        misfit: Sum of squares of error over noise.
        freedom: Readings minus parameters: the misfit that a right model has on average.
        names: Of the flat parameters.
        logarithmic: Which parameters are fitted by their logarithm.
        at_bound: Which parameters lie at a bound.
        singular_values: Of J with the parameters scaled as in `Combination`, falling.
        combinations: Unit vectors in these scaled parameters, row by row, that go with them.
        experiments: The fitted records beside their predictions.
        held_out: The further records beside theirs.
        history: Misfit and largest change of a scaled parameter of every accepted step.
        last: The last step; pass it as `resume` to go on.
    """

    parameters: PyTree
    status: Status
    covariance: Float[np.ndarray, "n n"]
    misfit: float
    freedom: int
    names: tuple[str, ...] = eqx.field(static=True)
    logarithmic: Bool[np.ndarray, " n"]
    at_bound: Bool[np.ndarray, " n"]
    singular_values: Float[np.ndarray, " free"]
    combinations: Float[np.ndarray, "free n"]
    experiments: tuple[Check, ...]
    held_out: tuple[Check, ...]
    history: dict[str, Float[np.ndarray, " steps"]]
    last: Any

    @property
    def standard_errors(self) -> PyTree:
        """Standard deviation of every parameter in its unit, like the parameters."""
        back = ravel_pytree(self.parameters)[1]
        return back(jax.numpy.asarray(np.sqrt(np.diag(self.covariance))))

    @property
    def correlation(self) -> Float[np.ndarray, "n n"]:
        """Correlation of the errors; NaN for what is held or not seen."""
        deviation = np.sqrt(np.diag(self.covariance))
        known = np.isfinite(deviation) & (deviation > 0)
        deviation = np.where(known, deviation, np.nan)
        return self.covariance / np.outer(deviation, deviation)

    @property
    def reduced_misfit(self) -> float:
        """Misfit per degree of freedom: about 1 where model and noise are right. Where only
        the noise is unknown, the covariance times this number takes it from the readings."""
        return self.misfit / self.freedom if self.freedom > 0 else float("nan")

    def __str__(self) -> str:
        values = ravel_pytree(self.parameters)[0]
        errors = np.sqrt(np.diag(self.covariance))
        rows = [f"misfit {self.misfit:.4g} with {self.freedom} degrees of freedom"]
        rows += [
            f"  {name:<20s} {float(p):.5g} +- {e:.2g}{'  at its bound' * bool(bound)}"
            for name, p, e, bound in zip(self.names, values, errors, self.at_bound, strict=True)
        ]
        rows += [f"  not seen: {each}" for each in unidentifiable(self)]
        rows += [f"  {check}" for check in self.experiments]
        rows += [f"  held out, {check}" for check in self.held_out]
        return "\n".join(rows)


def unidentifiable(calibration: Calibration, limit: float = 1.0) -> tuple[Combination, ...]:
    """Combinations of parameters that the experiments do not tell to better than `limit`.

    A standard deviation of 1 is a factor of e for logarithmic parameters and the size of the
    first guess for others. An experiment that moves the combination would determine it.

    Args:
        calibration: From `calibrate`.
        limit: Least standard deviation that is listed [-].

    Returns:
        The combinations.
    """
    found = []
    for value, row in zip(calibration.singular_values, calibration.combinations, strict=True):
        blind = value <= _BLIND * calibration.singular_values[0]
        deviation = float("inf") if blind else float(1 / value)
        if deviation > limit:
            row = row * np.sign(row[np.argmax(np.abs(row))])
            pairs = zip(calibration.names, row, strict=True)
            weights = {name: float(w) for name, w in pairs if abs(w) > _SHARE}
            found.append(Combination(weights, deviation))
    return tuple(found)


def validate(
    calibration: Calibration, experiments: tuple[Experiment, ...]
) -> tuple[Check, ...]:
    """Further records beside their predictions: held out, they tell what the model is worth.

    Each takes one solve and one back-substitution for every parameter.

    Args:
        calibration: From `calibrate`.
        experiments: Records that the calibration has not seen.

    Returns:
        One prediction with its error per record.
    """
    p, covariance = calibration.parameters, calibration.covariance
    return tuple(compared(e, p, covariance) for e in experiments)


def compared(experiment: Experiment, parameters: PyTree, covariance) -> Check:
    """`experiment` beside its prediction with parameters of this `covariance`."""
    value = predicted(experiment, parameters)
    error = value - np.asarray(experiment.measured)
    unit = directions_of(parameters, np.eye(len(covariance)))
    normalised, slopes = sensitivity(experiment, parameters, unit)
    with np.errstate(invalid="ignore"):
        variance = _quadratic(slopes, covariance)
    expected = np.full(value.shape, np.nan)
    noise = np.broadcast_to(experiment.noise, value.shape)
    expected[experiment.read] = np.sqrt(variance) * noise[experiment.read]
    rms = float(np.sqrt(np.mean(normalised**2)))
    return Check(experiment.name, value, error, rms, expected)


def _quadratic(slopes, covariance) -> np.ndarray:
    """diag(S C S'), where an infinite variance counts only if its slope is not zero."""
    unknown = ~np.isfinite(np.diag(covariance))
    finite = np.where(unknown[:, None] | unknown[None], 0.0, covariance)
    variance = np.einsum("ri,ij,rj->r", slopes, finite, slopes)
    touched = np.any(slopes[:, unknown] != 0, axis=1)
    return np.where(touched, np.inf, variance)


def spectrum(jacobian: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Singular values of the columns in `free`, and right vectors of all columns."""
    _, values, right = np.linalg.svd(jacobian[:, free], full_matrices=True)
    values = np.concatenate([values, np.zeros(free.sum() - len(values))])
    rows = np.zeros((free.sum(), len(free)))
    rows[:, free] = right
    return values, rows


def covariance_of(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(J'J)^-1 from its spectrum; infinite where a combination is not seen at all."""
    blind = values <= _BLIND * values.max(initial=0.0)
    seen = rows[~blind] / values[~blind, None]
    covariance = seen.T @ seen
    lost = np.any(np.abs(rows[blind]) > 1e-6, axis=0)
    covariance[lost] = covariance[:, lost] = np.nan
    covariance[lost, lost] = np.inf
    return covariance
