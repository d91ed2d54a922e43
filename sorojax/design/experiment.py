"""Experiments: what was measured, how well, and what a model says to it."""

import functools
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from sorojax import _check
from sorojax._types import real
from sorojax.fem import ConvergenceError, MotionError

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
    """What the model says.

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
    """What `function` returns, None where the model has no answer."""
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
