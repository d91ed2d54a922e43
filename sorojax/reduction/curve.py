"""Material curves of a solid: where a rod's axis lies in the reference configuration."""

import abc
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real

_DENSE = 4001  # points by which arc length is counted


class AbstractCurve(eqx.Module):
    """A curve in the reference configuration, parametrised by s in [0, 1] at any speed."""

    @abc.abstractmethod
    def __call__(self, s: Float[Array, " points"]) -> Float[Array, "points dim"]:
        """Points [m]."""


class Line(AbstractCurve):
    """The straight line from `start` to `end` [m], in the plane or in space."""

    start: Float[Array, " dim"] = eqx.field(converter=real)
    end: Float[Array, " dim"] = eqx.field(converter=real)

    def __check_init__(self):
        dim = 3 if jnp.shape(self.start) == (3,) else 2
        do = "Give (x, y) in metres, or (x, y, z) in space."
        _check.shape("Line", "start", self.start, (dim,), do)
        _check.shape("Line", "end", self.end, (dim,), do)
        if _check.is_concrete(self.start) and np.allclose(self.start, self.end, rtol=0, atol=0):
            raise ValueError(
                f"Line: `start` and `end` are both {np.asarray(self.start)} m. Give two points."
            )

    def __call__(self, s):
        return self.start[None] + s[:, None] * (self.end - self.start)[None]


class Curve(AbstractCurve):
    """Any smooth curve, by a function from s in [0, 1] to points (n, dim) [m]."""

    function: Callable = eqx.field(static=True)

    def __call__(self, s):
        return jnp.asarray(self.function(s))


class Reference(NamedTuple):
    """Equally spaced samples of a curve with a frame that does not turn about it.

    Attributes:
        s: Arc length over length.
        length: [m].
        position: [m].
        frame: Columns are the axes of the section; the first is the tangent.
    """

    s: Float[np.ndarray, " samples"]
    length: float
    position: Float[np.ndarray, "samples dim"]
    frame: Float[np.ndarray, "samples dim dim"]


def reference(curve: AbstractCurve, samples: int, up=None) -> Reference:
    """Samples of `curve` and its frames, on the host.

    Args:
        curve: The curve.
        samples: How many, ends included.
        up: In space, a direction near which local z starts; by default the axis of space
            that is most across the curve, the last one first.

    Raises:
        ValueError: If there are fewer than 3 samples, or the curve stands still somewhere.

    Reference:
        Wang, Juettler, Zheng, Liu, Computation of rotation minimizing frames, ACM
        Transactions on Graphics 27, 2008, for the double reflection.
    """
    if samples < 3:
        raise ValueError(f"backbone: got {samples} samples, need 3 or more. 81 are usual.")
    dense = np.linspace(0.0, 1.0, _DENSE)
    velocity = _with_slope(curve, jnp.asarray(dense))[1]
    speed = np.linalg.norm(np.asarray(velocity), axis=1)
    if not speed.min() > 1e-9 * speed.max():
        raise ValueError(
            "backbone: the curve stands still at a point, need a smooth parametrisation."
        )
    steps = np.diff(dense) * (speed[1:] + speed[:-1]) / 2
    way = np.concatenate([[0.0], np.cumsum(steps)])
    s = np.linspace(0, 1, samples)
    position, slope = _with_slope(curve, jnp.asarray(np.interp(s * way[-1], way, dense)))
    tangent = np.asarray(slope) / np.linalg.norm(np.asarray(slope), axis=1)[:, None]
    position = np.asarray(position)
    return Reference(s, float(way[-1]), position, _frames(position, tangent, up))


@eqx.filter_jit
def _with_slope(curve: AbstractCurve, s: Array) -> tuple[Array, Array]:
    return jax.jvp(curve, (s,), (jnp.ones_like(s),))


def _frames(position: np.ndarray, tangent: np.ndarray, up) -> np.ndarray:
    if position.shape[1] == 2:
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        return np.stack([tangent, normal], axis=2)
    across = [_start(tangent[0], up)]
    for k in range(len(tangent) - 1):
        chord = position[k + 1] - position[k]
        normal, bent = (_mirror(v, chord) for v in (across[-1], tangent[k]))
        across.append(_mirror(normal, tangent[k + 1] - bent))
    z = np.stack(across)
    return np.stack([tangent, np.cross(z, tangent), z], axis=2)


def _start(tangent: np.ndarray, up) -> np.ndarray:
    if up is None:
        up = np.eye(3)[2] if abs(tangent[2]) < 0.9 else np.eye(3)[1]
    across = np.asarray(up, float) - np.dot(up, tangent) * tangent
    size = np.linalg.norm(across)
    if not size > 1e-6:
        raise ValueError(f"backbone: `up` is {up}, need a direction across the curve.")
    return across / size


def _mirror(vector: np.ndarray, normal: np.ndarray) -> np.ndarray:
    square = normal @ normal
    return vector if square < 1e-28 else vector - 2 * (normal @ vector) / square * normal
