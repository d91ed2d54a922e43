"""`animate`: a film of any result that moves, one scene per instant."""

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from sorojax.view import style
from sorojax.view.film.film import Film, Frame, frames_at, renderer_of
from sorojax.view.raster.camera import View, camera_at
from sorojax.view.raster.plane import bar_beside, draw_plane, name_parts
from sorojax.view.raster.scene import Scale, Scene, box_around
from sorojax.view.raster.solid import (
    annotate,
    chosen_renderer,
    frame as frame_of,
    lens_of,
    picture_of,
)


@dataclass(frozen=True, eq=False)
class Track:
    """Scenes at instants: what a film is made of.

    Attributes:
        time: Instants [s], or any number that rises.
        scene: `scene(k)` is that of instant k.
        scale: Of all scenes, if they have values.
        unit: Of `time`, for the stamp; empty for seconds that are not stamped.
        extent: Lower and upper corner [m] of all scenes; found from them if omitted.
        name: Heading of the panel.
    """

    time: Float[np.ndarray, " instants"]
    scene: Callable[[int], Scene]
    scale: Scale | None = None
    unit: str = "s"
    extent: tuple[np.ndarray, np.ndarray] | None = None
    name: str = ""


def animate(
    result: Any,
    *,
    beside: Any = None,
    names: Sequence[str] = (),
    fps: float = 20.0,
    speed: float | None = None,
    view: View = "iso",
    renderer: str = "auto",
    samples: int = 1,
    shadows: bool = False,
    stamp: bool = True,
    size: tuple[int, int] = (640, 480),
    title: str = "",
    **options: Any,
) -> Film:
    """A film of a motion; `.save("name.webp")`, `.gif` or `.mp4` writes it.

    Args:
        result: A trajectory of a body, a rod (with `model=`) or a network (with `network=`), a
            path of a body, modes, the history of a design, or a `Track`.
        beside: A second result or `Track`, e.g. what was measured, drawn at the same
            instants in a panel of its own.
        names: Headings of the panels.
        fps: Frames per second.
        speed: Of the film over that of the motion: 1 in real time, 0.1 in slow motion. A
            path without time takes 3 s.
        view: A preset, a `Camera`, or a path of them, `orbit()` or `between(a, b)`.
        renderer: Of solid pictures: "auto", "own" or "pyvista".
        samples: Per pixel and direction, of the own renderer; 2 is smoother and slower.
        shadows: Whether bodies throw shadows on each other, in solid pictures.
        stamp: Write the time into the picture.
        size: Width and height [pixels].
        title: Heading of the film.
        **options: What to draw, as of `show`: `field=`, `limits=`, `forces=`, `section=`.

    Returns:
        The film, drawn frame by frame while it is saved.

    Raises:
        TypeError: If the result does not move.
        ValueError: If times do not rise or a frame cannot be drawn.
    """
    from sorojax.view.film.tracks import track_of

    tracks = [track_of(result, **options)]
    if beside is not None:
        tracks.append(track_of(beside, **options))
        tracks = _alike(tracks)
    tracks = [replace(t, name=name) for t, name in zip(tracks, names, strict=False)] or tracks
    main = tracks[0]
    if speed is None:
        speed = 1.0 if main.unit in ("s", "") else float(np.ptp(main.time)) / 3.0 or 1.0
    chosen = frames_at(main.time, fps, float(speed))
    stage = _Solid if main.scene(0).dim == 3 else _Plane
    looks = {"renderer": renderer, "samples": samples, "shadows": shadows}
    drawn = stage(tracks, chosen, view, looks, stamp, size, title)
    return Film(drawn.frame, len(chosen), fps)


def _alike(tracks: list[Track]) -> list[Track]:
    """One box and one scale of colours for panels that are to be compared."""
    extent = box_around([_extent(track) for track in tracks])
    scales = [track.scale for track in tracks if track.scale is not None]
    scale = scales[0] if scales else None
    if len(scales) == 2 and scales[0].label == scales[1].label:
        low, high = min(s.low for s in scales), max(s.high for s in scales)
        scale = replace(scales[0], low=low, high=high)
    return [replace(t, extent=extent, scale=t.scale and scale) for t in tracks]


def _extent(track: Track) -> tuple[np.ndarray, np.ndarray]:
    """Box around the scenes of all instants, from at most 60 of them."""
    if track.extent is not None:
        return track.extent
    some = np.unique(np.linspace(0, len(track.time) - 1, 60).astype(int))
    return box_around([track.scene(int(k)).box for k in some])


class _Stage(abc.ABC):
    """A figure of which only the panels and the stamp are drawn again."""

    def __init__(self, tracks, chosen, view, looks, stamp, size, title):
        self.tracks, self.chosen, self.view, self.looks = tracks, chosen, view, looks
        self.stamp, self.title = stamp, title
        self.boxes = [_extent(track) for track in tracks]
        self.figure = style.new_figure(size[0] / 100, size[1] / 100, layout=self.layout)
        self.figure.set_dpi(100)
        self.frame = self.prepare()

    layout: Any = None

    @abc.abstractmethod
    def prepare(self) -> Callable[[int], Frame]:
        """Draw what stands still; returns what draws frame k of the film."""

    def scene(self, track: Track, k: int) -> Scene:
        """The scene nearest to the instant of frame k, with the scale and box of the film."""
        at = int(self.chosen[k])
        if track is not self.tracks[0]:
            at = int(np.argmin(np.abs(track.time - self.tracks[0].time[at])))
        return replace(track.scene(at), scale=track.scale, title="")

    def stamp_on(self, on: Any, x: float, y: float, va: str, **look: Any) -> Any:
        look |= {"fontsize": style.LABEL, "family": "monospace"}
        return style.write(on, x, y, self.stamped(0), ha="left", va=va, **look)

    def stamped(self, k: int) -> str:
        """The time or the load of frame k."""
        track = self.tracks[0]
        value = float(track.time[self.chosen[k]])
        if not self.stamp or not track.unit:
            return ""
        digits = max(0, 2 - int(np.floor(np.log10(max(np.ptp(track.time), 1e-9)))))
        if np.all(track.time == np.round(track.time)):  # steps
            digits = 0
        return f"{value:.{min(digits, 6)}f} {track.unit}"


class _Plane(_Stage):
    """Panels of matplotlib; axes, bars and names stand still."""

    layout = "constrained"

    def prepare(self) -> Callable[[int], Frame]:
        boxes = [(1e3 * low, 1e3 * high) for low, high in self.boxes]
        span = boxes[0][1] - boxes[0][0]
        wide = span[0] > 1.6 * span[1]
        count = len(self.tracks)
        grid = (count, 1) if wide else (1, count)
        self.axes = list(self.figure.subplots(*grid, squeeze=False).ravel())
        for axes, track, (low, high) in zip(self.axes, self.tracks, boxes, strict=True):
            style.dress_plane(axes, low, high)
            axes.set_title(track.name, fontsize=style.LABEL, color=style.INK, loc="center")
            first = self.scene(track, 0)
            sketch = draw_plane(axes, first)
            name_parts(axes, first)
            for artist in sketch:  # the legend keeps copies
                artist.remove()
        scale = next((t.scale for t in self.tracks if t.scale is not None), None)
        if scale is not None:
            bar_beside(self.figure, self.axes, scale)
        style.title(self.figure, self.title)
        first = self.axes[0]
        self.text = self.stamp_on(first, 0.0, 1.02, "bottom", transform=first.transAxes)
        self.drawn: list[Any] = []
        return renderer_of(self.figure, self._artists)

    def _artists(self, k: int) -> list[Any]:
        while self.drawn:
            self.drawn.pop().remove()
        for axes, track in zip(self.axes, self.tracks, strict=True):
            self.drawn += draw_plane(axes, self.scene(track, k))
        self.text.set_text(self.stamped(k))
        return [*self.drawn, self.text]


class _Solid(_Stage):
    """Shaded pictures put into a frame that is drawn once."""

    def prepare(self) -> Callable[[int], Frame]:
        chosen_renderer(self.looks["renderer"])
        self.firsts = [track.scene(0).parts for track in self.tracks]
        self.places, count = [], len(self.tracks)
        first = replace(self.scene(self.tracks[0], 0), title=self.title)
        whole, _ = frame_of(self.figure, first)
        place = whole.get_position()
        whole.remove()
        heading = 0.05 if any(track.name for track in self.tracks) else 0.0
        for k, track in enumerate(self.tracks):
            wide = place.width / count
            left = place.x0 + k * wide
            axes = self.figure.add_axes((left, place.y0, wide, place.height - heading))
            box = axes.get_window_extent()
            size = int(box.width), int(box.height)
            corner = int(box.x0), int(round(self.figure.bbox.height - box.y1))
            lens = self._lens(track, size, 0.0)
            axes.set_xlim(0, size[0])
            axes.set_ylim(size[1], 0)
            axes.axis("off")
            axes.set_title(track.name, fontsize=style.LABEL, color=style.INK)
            if k == 0 and not callable(self.view):
                annotate(self.figure, axes, first, lens)
            self.places.append((corner, size))
        self.canvas: Any = self.figure.canvas
        self.canvas.draw()
        self.still = np.asarray(self.canvas.buffer_rgba())[:, :, :3].copy()
        named = [axes for axes in self.figure.axes if axes.get_legend() is not None]
        top = named[0].get_position().y1 - 0.01 if named else 0.965  # below the names
        self.text = self.stamp_on(self.figure, 0.015, top, "top")
        return self._frame

    def _lens(self, track: Track, size: tuple[int, int], share: float):
        index = self.tracks.index(track)
        whole = Scene(self.firsts[index], extent=self.boxes[index])
        return lens_of([whole], camera_at(self.view, share), size)

    def _frame(self, k: int) -> Frame:
        picture = self.still.copy()
        share = k / max(len(self.chosen) - 1, 1)
        look = self.looks | {"dots_per_point": 100 / 72}
        for track, ((x, y), size) in zip(self.tracks, self.places, strict=True):
            lens = self._lens(track, size, share)
            seen = picture_of(self.scene(track, k), lens, **look)
            part = picture[y : y + size[1], x : x + size[0]]
            # names and axes stay in front: they are darker than the paper of the picture
            np.minimum(part, seen[: part.shape[0], : part.shape[1]], out=part)
        if text := self.stamped(k):
            self.text.set_text(text)
            picture = self._written(picture)
        return picture

    def _written(self, picture: Frame) -> Frame:
        """The stamp drawn over the picture."""
        renderer = self.canvas.get_renderer()
        renderer.clear()
        self.text.draw(renderer)
        ink = np.asarray(self.canvas.buffer_rgba()).astype(np.uint16)
        share = ink[:, :, 3:]
        rows = np.flatnonzero(share.any(axis=(1, 2)))
        if not len(rows):
            return picture
        at = slice(rows[0], rows[-1] + 1)
        mixed = (ink[at, :, :3] * share[at] + picture[at] * (255 - share[at])) // 255
        picture[at] = mixed.astype(np.uint8)
        return picture
