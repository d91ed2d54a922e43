"""Markers with identities, followed from frame to frame."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sorojax.vision.discs import Colour, Discs, Image, find_discs, refine_discs


class Tracks(NamedTuple):
    """Markers by identity: their place in these arrays.

    Attributes:
        discs: Where each one was last, or is predicted to be while it is not seen.
        velocity: In pixels per frame.
        unseen: Frames since it was seen; stale from `STALE` on.
    """

    discs: Discs
    velocity: Float[np.ndarray, "n 2"]
    unseen: Int[np.ndarray, " n"]

    @property
    def stale(self) -> np.ndarray:
        return self.unseen >= STALE


STALE = 3
_JUMP = 0.8  # of the radius: farther than that the moments have caught something else


def start_tracks(discs: Discs) -> Tracks:
    """Identities for discs, in their order."""
    count = len(discs.radius)
    return Tracks(discs, np.zeros((count, 2)), np.zeros(count, int))


def follow(image: Image, tracks: Tracks, colours: tuple[Colour, ...]) -> Tracks:
    """The tracks one frame later.

    Only windows around the predicted centres are looked at. A marker that is not there is
    searched for in the whole image, nearest first; what is not found moves on at its
    speed, slowing down.
    """
    guess = tracks.discs._replace(centre=tracks.discs.centre + tracks.velocity)
    seen = refine_discs(image, guess, colours).centre
    away = np.linalg.norm(seen - guess.centre, axis=1)
    missing = ~(away <= _JUMP * tracks.discs.radius)
    if np.any(missing):
        seen = _searched(image, guess, seen, missing, colours)
        missing = ~np.isfinite(seen[:, 0])
    centre = np.where(missing[:, None], guess.centre, seen)
    fresh = tracks.unseen == 0
    speed = np.where(fresh[:, None], centre - tracks.discs.centre, 0.0)
    velocity = np.where(missing[:, None], 0.5 * tracks.velocity, speed)
    unseen = np.where(missing, tracks.unseen + 1, 0)
    return Tracks(guess._replace(centre=centre), velocity, unseen)


def _searched(image, guess: Discs, seen, missing, colours) -> np.ndarray:
    """`seen` with the missing ones taken from the discs that nobody else has, or NaN."""
    from scipy.optimize import linear_sum_assignment

    seen = np.where(missing[:, None], np.nan, seen)
    low, high = 0.7 * guess.radius.min(), 1.4 * guess.radius.max()
    found = find_discs(image, colours, radius=(low, high))
    lost = np.flatnonzero(missing)
    gap = np.linalg.norm(found.centre[None] - guess.centre[lost][:, None], axis=2)
    gap = np.where(found.colour[None] == guess.colour[lost][:, None], gap, np.inf)
    for k, centre in enumerate(found.centre):
        others = np.linalg.norm(seen[~missing] - centre, axis=1)
        if np.any(others < found.radius[k]):
            gap[:, k] = np.inf
    if gap.size:
        far = 1e6
        for row, column in zip(*linear_sum_assignment(np.minimum(gap, far)), strict=True):
            if gap[row, column] < far:
                seen[lost[row]] = found.centre[column]
    return seen


# Markers in the images of a camera, as a loop wants them: places, whenever it asks


class MarkerStream:
    """Discs followed from image to image.

    Args:
        camera: Anything whose `read()` gives an image with `.colour`, or None without a new
            one.
        first: Where the discs are, in pixels, with their identities.
        colours: Of the discs, by the numbers in `first.colour`.
        place: From pixels to metres, `lambda px: (px - corner) / scale` for a camera that
            looks straight at a plane; pixels if omitted.

    Attributes:
        tracks: Of the last image.
        images: How many there were.
    """

    def __init__(
        self,
        camera: Any,
        first: Discs,
        colours: tuple[Colour, ...],
        place: Callable[[np.ndarray], np.ndarray] | None = None,
    ):
        self._camera, self._colours = camera, colours
        self._place = (lambda pixels: pixels) if place is None else place
        self._nothing = np.full(first.centre.shape, np.nan)
        self.tracks, self.images = start_tracks(first), 0

    def read(self) -> Float[np.ndarray, "discs 2"]:
        """Places of the discs in a new image; NaN where there is none."""
        image = self._camera.read()
        if image is None:
            return self._nothing
        self.images += 1
        self.tracks = follow(image.colour, self.tracks, self._colours)
        return self._place(self.tracks.discs.centre)
