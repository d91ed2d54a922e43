"""Markers in the images of a camera, as a loop wants them: places, whenever it asks."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from sorojax.vision.colour import Colour
from sorojax.vision.discs import Discs
from sorojax.vision.tracking import follow, start_tracks


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
