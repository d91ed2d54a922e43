"""Signs of what acts without an arrow of its own: coils of springs, arcs of turning."""

import numpy as np
from jaxtyping import Float

from sorojax.view.scene import Arrows, Lines, Part

_SWING = np.array([0.0, 0, 1, -1, 1, -1, 1, -1, 0, 0])
_ALONG = np.concatenate([[0.0], np.linspace(0.2, 0.8, 8), [1.0]])
_TURN = 1.5 * np.pi  # rad, of an arc


def coil(
    start: Float[np.ndarray, " dim"], end: Float[np.ndarray, " dim"], width: float
) -> Float[np.ndarray, "points dim"]:
    """The sign of a spring between two places, `width` [m] to each side."""
    along = end - start
    side = across(along / max(float(np.linalg.norm(along)), 1e-300))
    return start + np.outer(_ALONG, along) + width * np.outer(_SWING, side)


def turning(
    centre: Float[np.ndarray, " dim"],
    axis: Float[np.ndarray, "3"] | float,
    radius: float,
    colour: str,
    name: str = "",
) -> list[Part]:
    """An arc with a head about `centre`: counter-clockwise about `axis` in space, in the
    plane by the sign of the number `axis`."""
    if len(centre) == 2:
        first, second = np.array([1.0, 0.0]), np.array([0.0, float(np.sign(axis))])
    else:
        along = np.asarray(axis) / np.linalg.norm(axis)
        first = across(along)
        second = np.cross(along, first)
    angle = np.linspace(0.0, _TURN, 49)
    arc = centre + radius * (np.outer(np.cos(angle), first) + np.outer(np.sin(angle), second))
    ahead = np.cos(_TURN) * second - np.sin(_TURN) * first
    head = Arrows(arc[-1:], 0.45 * radius * ahead[None], colour)
    return [Lines([arc], colour, 1.6, name=name), head]


def across(along: Float[np.ndarray, " dim"]) -> Float[np.ndarray, " dim"]:
    """A unit vector perpendicular to the unit vector `along`, to its left in the plane."""
    if len(along) == 2:
        return np.array([-along[1], along[0]])
    side = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    return side / np.linalg.norm(side)
