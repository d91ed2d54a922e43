"""Films: one figure whose moving parts are drawn again for every frame."""

import io
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sorojax._progress import report

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure
    from PIL.Image import Image

_COLOURS = 96
_SAMPLES = 6


@dataclass(frozen=True)
class Film:
    """An animated picture: a GIF file in memory, its number of frames and their rate [1/s]."""

    gif: bytes
    frames: int
    fps: float

    def save(self, path: str | Path) -> Path:
        """Write the file and return its path."""
        path = Path(path)
        path.write_bytes(self.gif)
        return path


def animate(
    figure: "Figure",
    update: Callable[[int], "Iterable[Artist]"],
    frames: int,
    *,
    fps: float = 20.0,
    label: str = "film",
) -> Film:
    """Draw `frames` frames of a figure.

    What stands still is drawn once: only the artists that `update` returns are drawn
    for every frame, in their order.

    Args:
        figure: From `matplotlib.figure.Figure`, with everything in it.
        update: `update(k)` moves the artists of frame k and returns them, always the same
            ones; they must lie in axes.
        frames: Number of frames.
        fps: Frames per second, at most 50.
        label: Name in the progress report.
    """
    if frames < 1 or not 0 < fps <= 50:
        raise ValueError(
            f"animate: got {frames} frames at {fps:g} per second, need 1 or more at up to 50. "
            "A GIF cannot be faster: show every second frame."
        )
    render = _renderer(figure, update)
    samples = np.unique(np.linspace(0, frames - 1, _SAMPLES).astype(int)).tolist()
    palette = _palette([render(k) for k in samples])
    pictures = []
    for k in range(frames):
        pictures.append(render(k).quantize(palette=palette, dither=_no_dither()))
        report(label, k + 1, frames)
    buffer = io.BytesIO()
    pictures[0].save(
        buffer, "GIF", save_all=True, append_images=pictures[1:], loop=0, optimize=False,
        duration=round(100 / fps) * 10, disposal=1,
    )  # fmt: skip
    return Film(buffer.getvalue(), frames, fps)


def _renderer(figure: "Figure", update) -> "Callable[[int], Image]":
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    canvas = FigureCanvasAgg(figure)
    for artist in update(0):
        artist.set_animated(True)
    canvas.draw()
    # The layout must not move under the parts that are kept.
    figure.set_layout_engine("none")
    canvas.draw()
    still = canvas.copy_from_bbox(figure.bbox)

    def render(k: int) -> Image.Image:
        canvas.restore_region(still)
        for artist in update(k):
            artist.draw(canvas.get_renderer())
        return Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3].copy())

    return render


def _palette(pictures: "list[Image]") -> "Image":
    """One palette for the whole film, so that what stands still stays still."""
    from PIL import Image

    width, height = pictures[0].size
    sheet = Image.new("RGB", (width, height * len(pictures)))
    for k, picture in enumerate(pictures):
        sheet.paste(picture, (0, k * height))
    found = sheet.quantize(_COLOURS, method=Image.Quantize.MEDIANCUT)
    colours = np.array(found.getpalette()).reshape(-1, 3)
    colours[colours.min(axis=1) >= 246] = 255  # averaging turns white paper grey
    found.putpalette(colours.astype(np.uint8).tobytes())
    return found


def _no_dither() -> Any:
    from PIL import Image

    return Image.Dither.NONE


def frames_at(time: np.ndarray, fps: float) -> np.ndarray:
    """Samples of `time` that are nearest to the instants of a film in real time."""
    if time.ndim != 1 or len(time) < 1 or np.any(np.diff(time) <= 0):
        raise ValueError(
            f"film: `time` has shape {time.shape} and must rise strictly. Give the instants of "
            "the frames [s]."
        )
    count = int(np.floor((time[-1] - time[0]) * fps + 1e-9)) + 1
    wanted = time[0] + np.arange(count) / fps
    right = np.clip(np.searchsorted(time, wanted), 1, max(len(time) - 1, 1))
    right = np.minimum(right, len(time) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(wanted - time[left] <= time[right] - wanted, left, right)
