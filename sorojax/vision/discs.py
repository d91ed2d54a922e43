"""Coloured discs in images, and markers with identities, followed from frame to frame."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from sorojax.vision.camera import opencv

Image = UInt8[np.ndarray, "height width 3"]


class Colour(NamedTuple):
    """A window of hue, `width` wide about `hue` [degrees, 0 to 360], with the least
    `saturation` and `value` [0 to 1]."""

    hue: float
    width: float = 24.0
    saturation: float = 0.35
    value: float = 0.2


RED, GREEN, BLUE = Colour(0.0), Colour(122.0, 54.0), Colour(228.0, 56.0)


def colour_mask(image: Image, colour: Colour) -> Bool[np.ndarray, "height width"]:
    """Pixels of a blue-green-red image that have the colour.

    Args:
        image: Blue, green, red, 8 bits each.
        colour: Its range.

    Returns:
        True where the pixel has it.
    """
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


# Coloured discs in an image: fast search, sub-pixel centres, and the circular Hough way


_MARGIN = 3.5  # px around a disc that its blur reaches


class Discs(NamedTuple):
    """Discs that were found: `centre` and `radius` [px], and `colour`, its number among those
    asked for."""

    centre: Float[np.ndarray, "n 2"]
    radius: Float[np.ndarray, " n"]
    colour: Int[np.ndarray, " n"]


def find_discs(
    image: Image,
    colours: tuple[Colour, ...],
    *,
    radius: tuple[float, float] = (6.0, 30.0),
    refine: bool = True,
) -> Discs:
    """Discs of the given colours, ordered by colour and then by area, largest first.

    Contours of the colour masks at half resolution (where the smallest radius allows it),
    then the moments of how much of each pixel is covered, at full resolution.

    Args:
        image: Blue, green, red.
        colours: What to look for.
        radius: Smallest and largest radius [px].
        refine: Whether to find centres to a fraction of a pixel.

    Returns:
        Centres and radii [px], and colours.
    """
    cv2, (smallest, largest) = opencv(), radius
    stride = 2 if smallest >= 6 else 1
    small = np.ascontiguousarray(image[::stride, ::stride])
    hsv = cv2.cvtColor(small, cv2.COLOR_BGR2HSV)
    found = []
    for index, colour in enumerate(colours):
        contours, _ = cv2.findContours(
            masked(hsv, colour), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        seen = [_disc_of(contour, stride) for contour in contours if len(contour) >= 5]
        seen = [s for s in seen if smallest <= s[2] <= largest]
        found += [(*s, index) for s in sorted(seen, key=lambda s: -s[2])]
    discs = _discs(found)
    return refine_discs(image, discs, colours) if refine else discs


def refine_discs(image: Image, discs: Discs, colours: tuple[Colour, ...]) -> Discs:
    """The same discs with centres from first moments of the covered part of each pixel.

    Works from centres that are a few pixels off, which is how a tracker uses it. Where
    there is no colour at all the centre is NaN.

    Args:
        image: Blue, green, red, 8 bits each.
        discs: With centres that are a few pixels off.
        colours: What to look for.

    Returns:
        The discs.
    """
    centres = discs.centre.astype(float)
    for k, index in enumerate(discs.colour):
        for reach in (discs.radius[k] + 2 * _MARGIN, discs.radius[k] + _MARGIN):
            centres[k] = _moments(image, colours[index], centres[k], reach)
    return discs._replace(centre=centres)


def hough_discs(
    image: Image,
    colours: tuple[Colour, ...],
    *,
    radius: tuple[float, float] = (6.0, 30.0),
    refine: bool = False,
) -> Discs:
    """Discs by the circular Hough transform of the colour masks.

    For discs that are half hidden or touch others; by itself about 0.6 px exact, and
    several times slower than `find_discs`.

    Args:
        image: Blue, green, red, 8 bits each.
        colours: What to look for.
        radius: Smallest and largest radius [px].
        refine: Whether to find centres to a fraction of a pixel.

    Returns:
        Centres and radii [px], and colours.
    """
    cv2 = opencv()
    hsv = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_BGR2HSV)
    low, high = (round(r) for r in radius)
    found = []
    for index, colour in enumerate(colours):
        smooth = cv2.GaussianBlur(masked(hsv, colour), (0, 0), 1.2)
        limits = {"param1": 150, "param2": 14, "minRadius": low, "maxRadius": high}
        circles = cv2.HoughCircles(smooth, cv2.HOUGH_GRADIENT, 1, 2 * low, **limits)
        for circle in [] if circles is None else circles.reshape(-1, 3):
            found.append((*circle, index))
    discs = _discs(found)
    return refine_discs(image, discs, colours) if refine else discs


def _disc_of(contour, stride: int) -> tuple[float, float, float]:
    (x, y), size, _ = opencv().fitEllipse(contour)
    return stride * x, stride * y, stride * (sum(size) / 4 + 0.5)


def _discs(found: list[tuple[float, float, float, int]]) -> Discs:
    table = np.array(found, float).reshape(-1, 4)
    return Discs(table[:, :2], table[:, 2], table[:, 3].astype(int))


def _moments(image: Image, colour: Colour, centre, reach: float) -> np.ndarray:
    height, width = image.shape[:2]
    if not np.all(np.isfinite(centre)):
        return np.full(2, np.nan)
    x0, y0 = (max(int(np.floor(c - reach)), 0) for c in centre)
    x1, y1 = int(np.ceil(centre[0] + reach)) + 1, int(np.ceil(centre[1] + reach)) + 1
    window = image[y0 : min(y1, height), x0 : min(x1, width)]
    if window.size == 0:
        return np.full(2, np.nan)
    x = np.arange(x0, x0 + window.shape[1]) - centre[0]
    y = np.arange(y0, y0 + window.shape[0]) - centre[1]
    covered = chroma(window, colour)
    covered *= (x * x)[None] + (y * y)[:, None] <= reach**2
    flat, rank = covered.ravel(), covered.size - covered.size // 40 - 1
    level = np.partition(flat, rank)[rank]
    if level < 12.0:  # the noise of a grey background is a few levels of 255
        return np.full(2, np.nan)
    covered *= covered > 0.1 * level
    down = covered.sum(axis=1)
    return centre + np.array([covered.sum(axis=0) @ x, down @ y]) / down.sum()


# Markers with identities, followed from frame to frame.


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
    """Identities for discs, in their order.

    Args:
        discs: From `find_discs`.

    Returns:
        One track per disc.
    """
    count = len(discs.radius)
    return Tracks(discs, np.zeros((count, 2)), np.zeros(count, int))


def follow(image: Image, tracks: Tracks, colours: tuple[Colour, ...]) -> Tracks:
    """The tracks one frame later.

    Only windows around the predicted centres are looked at. A marker that is not there is
    searched for in the whole image, nearest first; what is not found moves on at its
    speed, slowing down.

    Args:
        image: Blue, green, red, 8 bits each.
        tracks: Of the frame before.
        colours: What to look for.

    Returns:
        The tracks of this frame.
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
