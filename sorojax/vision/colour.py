"""Colours of markers: where they are, and how much of a pixel they cover."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from sorojax.vision._opencv import opencv

Image = UInt8[np.ndarray, "height width 3"]


class Colour(NamedTuple):
    """A window of hue [degrees, 0 to 360] with least saturation and value [0 to 1]."""

    hue: float
    width: float = 24.0
    saturation: float = 0.35
    value: float = 0.2


RED, GREEN, BLUE = Colour(0.0), Colour(122.0, 54.0), Colour(228.0, 56.0)


def colour_mask(image: Image, colour: Colour) -> Bool[np.ndarray, "height width"]:
    """Pixels of a blue-green-red image that have the colour."""
    hsv = opencv().cvtColor(np.ascontiguousarray(image), opencv().COLOR_BGR2HSV)
    return masked(hsv, colour).astype(bool)


def masked(hsv: Image, colour: Colour) -> UInt8[np.ndarray, "height width"]:
    """The same of an image in OpenCV's hue (half degrees), saturation, value; 0 or 255."""
    cv2 = opencv()
    low = round((colour.hue - colour.width / 2) / 2) % 180
    high = round((colour.hue + colour.width / 2) / 2) % 180
    floor = round(255 * colour.saturation), round(255 * colour.value)
    if low <= high:
        return cv2.inRange(hsv, (low, *floor), (high, 255, 255))
    return cv2.inRange(hsv, (low, *floor), (180, 255, 255)) | cv2.inRange(
        hsv, (0, *floor), (high, 255, 255)
    )


def chroma(image: Image, colour: Colour) -> Float[np.ndarray, "height width"]:
    """Strength of the colour, linear in the pixel and zero on any grey.

    Linear, so that a pixel that a marker covers in part has that part of its strength, and
    blur moves no centroid.
    """
    angle = np.deg2rad(colour.hue - np.array([240.0, 120.0, 0.0]))
    return opencv().transform(image.astype(np.float32), np.cos(angle)[None] / 1.5)
