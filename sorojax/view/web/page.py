"""Pages that show moving surfaces in any browser: one file, offline, no library inside."""

import base64
import html
import json
import os
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sorojax import _check, fem
from sorojax.fem.equilibrium.solve import Path as FemPath
from sorojax.io.animation import MovingSurface, export_animation
from sorojax.view import style
from sorojax.view.web.actor import Actor, actor, checked

_VALUE_LEVELS = 127
_LOOP = 4.0  # s that a film without times of its own takes
_HEIGHT = 520


# Numbers of a film as few bytes: int16 steps from frame to frame, deflated.
#
# A column of numbers is cut to 65535 levels between its ends. The first frame is kept, of the
# others the change from where the two before lead to, or from the one before, whichever packs
# smaller; low and high bytes go apart, and all through zlib. A browser undoes it with its own
# DecompressionStream.


LEVELS = 32767


class Packer:
    """Collects arrays into one run of bytes."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, content: bytes) -> int:
        """Where the content starts."""
        start = self._size
        padded = content + bytes(-len(content) % 4)
        self._parts.append(padded)
        self._size += len(padded)
        return start

    def numbers(self, values: np.ndarray, kind: str) -> dict[str, Any]:
        """Plain little-endian numbers, e.g. of kind "<u4"."""
        flat = np.ascontiguousarray(values, dtype=kind)
        return {"at": self.add(flat.tobytes()), "count": int(flat.size)}

    def frames(
        self, values: Float[np.ndarray, "frames columns points"], low, high, levels=LEVELS
    ) -> dict[str, Any]:
        """Numbers between `low` and `high` of each column, at steps of 1 / (2 levels)."""
        levels = quantised(values, low, high, levels)
        first = np.diff(levels, axis=0, prepend=np.zeros_like(levels[:1]))
        second = np.diff(first, axis=0, prepend=np.zeros_like(first[:1]))
        orders = {1: _planes(first), 2: _planes(second)}
        sizes = {order: len(zlib.compress(planes, 1)) for order, planes in orders.items()}
        order = min(sizes, key=lambda order: sizes[order])
        shape = [int(n) for n in levels.shape]
        return {"at": self.add(orders[order]), "shape": shape, "order": order}

    def text(self) -> str:
        """All of it, deflated and in base64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 6)).decode()


def quantised(values: np.ndarray, low, high, levels: int = LEVELS) -> np.ndarray:
    """Whole numbers from -levels to levels between `low` and `high`, one each per column."""
    low, high = (np.asarray(x, float)[None, :, None] for x in (low, high))
    half = np.maximum((high - low) / 2, 1e-300)
    share = np.clip((values - low) / half - 1, -1, 1)
    return np.rint(levels * share).astype(np.int16)


def _planes(steps: np.ndarray) -> bytes:
    """Low bytes, then high bytes; small steps of both signs have zero high bytes."""
    wide = steps.astype(np.int32)
    folded = ((wide << 1) ^ (wide >> 31)).astype(np.uint16)
    return (folded & 0xFF).astype(np.uint8).tobytes() + (folded >> 8).astype(np.uint8).tobytes()


# Pages


@dataclass(frozen=True)
class Page:
    """A page, `html`; the last line of a notebook cell shows it."""

    html: str

    def save(self, path: str | Path) -> Path:
        """Write the file and return its path."""
        path = Path(path)
        path.write_text(self.html, encoding="utf-8")
        return path

    def __repr__(self) -> str:
        return (
            f"Page({len(self.html.encode()) / 1e6:.2f} MB of HTML, write it with .save(path))"
        )

    def _repr_html_(self) -> str:
        inside = html.escape(self.html, quote=True)
        return (
            f'<iframe srcdoc="{inside}" width="100%" height="{_HEIGHT}" frameborder="0" '
            'sandbox="allow-scripts"></iframe>'
        )


def to_html(
    *things: Any,
    time: Any = None,
    clock: str = "t",
    unit: str = "s",
    label: str = "",
    limits: tuple[float, float] | None = None,
    title: str = "",
    path: str | Path | None = None,
) -> Page:
    """A page that plays what moves: orbit, scrub, slow motion, edges, colour bar.

    The file holds everything, needs no network and opens in any browser of 2023 or later,
    and in notebooks. Points are kept to 1/65534 of the room that an actor moves through.

    Args:
        *things: Actors, or what `actor` takes; all with the same number of frames, or one.
        time: One number per frame; those of a result of `fem` if omitted, else numbers.
        clock: Name of these numbers, e.g. "pressure".
        unit: Their unit; with "s" the page plays in real time.
        label: Name and unit of the values that colour the actors.
        limits: Values at the ends of the colours; the lowest and highest if omitted.
        title: Shown above the picture.
        path: Where to write the page as well.

    Returns:
        The page; `save` writes it, a notebook shows it.

    Raises:
        ValueError: If there is nothing to show or numbers of frames differ.
    """
    actors = [thing if isinstance(thing, Actor) else actor(thing) for thing in things]
    actors = [checked(each) for each in actors]
    frames = num_frames("to_html", actors)
    stamps, seconds = _times(things, time, clock, unit, frames)
    packer = Packer()
    limits = limits_of(actors) if limits is None else limits
    meta = {
        "title": title,
        "stamps": stamps,
        "seconds": seconds,
        "speed": _speed(seconds),
        "autoplay": frames > 1,
        "label": label if any(each.values is not None for each in actors) else "",
        "limits": list(limits),
        "levels": _VALUE_LEVELS,
        "ramp": colours_of_map(),
        "box": [list(corner) for corner in room(actors)],
        "actors": [described(each, limits, packer) for each in actors],
    }
    page = Page(filled(meta, packer))
    if path is not None:
        page.save(path)
    return page


def num_frames(where: str, actors: Sequence[Actor]) -> int:
    """The number of frames that all actors share."""
    if not actors:
        raise ValueError(f"{where}: got nothing to show, need one actor or more.")
    counts = {each.num_frames for each in actors}
    if len(counts - {1}) > 1:
        raise ValueError(
            f"{where}: the actors have {sorted(counts)} frames, need one number of frames. "
            "Take all at the same instants."
        )
    return max(counts)


def described(
    made: Actor, limits: tuple[float, float], packer: Packer, ends: Any = None
) -> dict[str, Any]:
    """An actor as the page reads it, its numbers in `packer`; `ends` are the corners of the
    box of its points if these will leave where they are."""
    low, high = _ends(made.points) if ends is None else ends
    found: dict[str, Any] = {
        "name": made.name,
        "colour": rgb(made.colour),
        "low": low.tolist(),
        "high": high.tolist(),
        "triangles": packer.numbers(made.triangles, "<u4"),
        "points": packer.frames(np.moveaxis(made.points, 2, 1), low, high),
        "poses": None,
        "values": None,
    }
    if made.poses is not None:
        found["poses"] = packer.numbers(np.moveaxis(made.poses, 2, 1), "<f4")
    if made.values is not None:
        ends = ([limits[0]], [limits[1]])
        values = made.values[:, None]
        found["values"] = packer.frames(values, *ends, levels=_VALUE_LEVELS)
    return found


def room(actors: Sequence[Actor]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the box that all actors move in [m]."""
    corners = []
    for each in actors:
        pick = np.stack(np.meshgrid(*zip(*_ends(each.points), strict=True)), axis=-1)
        pick = pick.reshape(-1, 3)
        if each.poses is not None:
            pick = np.einsum("fij,cj->fci", each.poses[:, :3, :3], pick)
            pick = (pick + each.poses[:, None, :3, 3]).reshape(-1, 3)
        corners.append(pick)
    every = np.concatenate(corners)
    return every.min(axis=0), every.max(axis=0)


def _ends(points: Float[np.ndarray, "frames points 3"]) -> tuple[np.ndarray, np.ndarray]:
    return points.min(axis=(0, 1)), points.max(axis=(0, 1))


def filled(meta: dict[str, Any], packer: Packer) -> str:
    """The page with its data."""
    parts = {
        "title": html.escape(meta["title"]),
        "style": style.asset("viewer.css"),
        "meta": json.dumps(meta, separators=(",", ":")).replace("<", "\\u003c"),
        "data": packer.text(),
        "script": style.asset("viewer.js", "camera.js", "player.js"),
    }
    return re.sub(r"\{(\w+)\}", lambda found: parts[found[1]], style.asset("viewer.html"))


def colours_of_map(count: int = 64) -> list[list[int]]:
    """Colours of the map of fields, in steps from low to high."""
    from matplotlib import colormaps

    rows = colormaps[style.FIELD](np.linspace(0, 1, count))[:, :3]
    return np.rint(255 * rows).astype(int).tolist()


def limits_of(actors: Sequence[Actor]) -> tuple[float, float]:
    values = [each.values for each in actors if each.values is not None]
    if not values:
        return 0.0, 1.0
    low = min(float(each.min()) for each in values)
    high = max(float(each.max()) for each in values)
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def _times(things, time, clock: str, unit: str, frames: int) -> tuple[list[str], list[float]]:
    """The text of each frame, and when the page shows it [s]."""
    if time is None:
        results = [t for t in things if isinstance(t, fem.Trajectory | FemPath)]
        first = results[0] if results else None
        if isinstance(first, fem.Trajectory):
            time = first.time
        elif first is not None and first.values.ndim == 1:
            time, clock, unit = first.values, first.name or "load factor", ""
    if time is None:
        stamps = [f"{k + 1} / {frames}" for k in range(frames)] if frames > 1 else [""]
        return stamps, np.linspace(0, _LOOP, frames).tolist()
    time = np.asarray(time, float)
    do = f"Give {frames} finite numbers, one per frame."
    _check.shape("to_html", "time", time, (frames,), do)
    _check.finite("to_html", "time", time, do)
    digits = _digits(time)
    stamps = [f"{clock} = {value:.{digits}f} {unit}".rstrip() for value in time]
    if unit != "s" or np.any(np.diff(time) <= 0):
        return stamps, np.linspace(0, _LOOP, frames).tolist()
    return stamps, time.tolist()


def _digits(time: np.ndarray) -> int:
    """Decimals that tell the frames apart."""
    steps = np.abs(np.diff(time))
    least = float(steps[steps > 0].min()) if np.any(steps > 0) else 1.0
    return int(np.clip(np.ceil(-np.log10(least)), 0, 6))


def _speed(seconds: Sequence[float]) -> float:
    """A rate at which a film takes about two to twenty seconds."""
    length = seconds[-1] - seconds[0]
    for speed in (1, 0.5, 0.25, 0.1, 0.03, 0.01):
        if length / speed >= 2 or length == 0:
            break
    for faster in (2, 5, 10, 30, 100):
        if length / speed > 30:
            speed = faster
    return speed


def rgb(colour: str) -> list[float]:
    if not re.fullmatch(r"#[0-9a-fA-F]{6}", colour):
        raise ValueError(f"actor: `colour` is {colour!r}, need a colour such as '#0072B2'.")
    return [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]


# Actors as an animated GLB file


def to_glb(
    path: str | os.PathLike,
    *things: Any,
    time: Float[Any, " frames"] | None = None,
    root: str | os.PathLike | None = None,
) -> Path:
    """Write what moves as a GLB file with animation.

    Morph targets carry changing shapes, node poses rigid motion. Colours of values stand
    still: they are those of the last frame.

    Args:
        path: File name, ending in .glb.
        *things: Actors, or what `actor` takes, as in `to_html`.
        time: Instants of the frames [s]; 25 frames per second if omitted.
        root: Folder that the file must lie in, links followed.

    Returns:
        The file written.
    """
    actors = [checked(t if isinstance(t, Actor) else actor(t)) for t in things]
    frames = num_frames("to_glb", actors)
    times = np.arange(frames) / 25 if time is None else np.asarray(time, float)
    limits = limits_of(actors)
    ramp = np.array(colours_of_map(), float) / 255
    shapes = []
    for each in actors:
        colours = np.array(rgb(each.colour))
        if each.values is not None:
            share = np.clip((each.values[-1] - limits[0]) / (limits[1] - limits[0]), 0, 1)
            colours = ramp[np.rint(share * (len(ramp) - 1)).astype(int)]
        shapes.append(
            MovingSurface(each.points, each.triangles, each.poses, colours, each.name)
        )
    export_animation(path, shapes, times, root=root)
    return Path(path) if root is None else Path(root) / path
