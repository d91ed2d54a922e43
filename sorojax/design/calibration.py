"""What a calibration found: parameters, how well they are known, and what was not seen.

Uncertainties are those of the linearised model: with the noise n_i of every reading and
r_i = (predicted - measured) / n_i the covariance is (J'J)^-1 for J = dr/dp.

Reference: Seber & Wild, Nonlinear Regression, 1989, chapters 2 and 5.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float, PyTree

from sorojax.design.experiment import Experiment, directions_of, predicted, sensitivity
from sorojax.math.status import Status

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
        rows += [f"  not seen: {each}" for each in unseen(self)]
        rows += [f"  {check}" for check in self.experiments]
        rows += [f"  held out, {check}" for check in self.held_out]
        return "\n".join(rows)


def unseen(calibration: Calibration, limit: float = 1.0) -> tuple[Combination, ...]:
    """Combinations of parameters that the experiments do not tell to better than `limit`.

    A standard deviation of 1 is a factor of e for logarithmic parameters and the size of the
    first guess for others. An experiment that moves the combination would determine it.
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


def checked(calibration: Calibration, experiments: tuple[Experiment, ...]) -> tuple[Check, ...]:
    """Further records beside their predictions: held out, they tell what the model is worth.

    Each takes one solve and one back-substitution for every parameter.
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
