"""Films: frames drawn on request, written as WebP, GIF, MP4 or single pictures."""

import functools
import importlib.util
import io
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from sorojax._progress import report

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure
    from PIL.Image import Image

_COLOURS = 96
_SAMPLES = 6
_GIF_FPS = 50.0
_QUALITY = 75

Frame = UInt8[np.ndarray, "height width 3"]


class Film:
    """An animated picture. Frames are drawn when they are needed, so a long film takes no
    memory.

    Attributes:
        draw: `draw(k)` is frame k as red, green, blue.
        frames: Number of frames.
        fps: Frames per second.
        label: Name in the progress report.
    """

    def __init__(self, draw: Callable[[int], Frame], frames: int, fps: float, label="film"):
        self.draw, self.frames, self.fps, self.label = draw, frames, fps, label

    def __repr__(self) -> str:
        seconds = self.frames / self.fps
        return f"Film: {self.frames} frames, {seconds:.3g} s; .save('name.webp' or '.mp4')"

    def __iter__(self) -> Iterator[Frame]:
        for k in range(self.frames):
            yield self.draw(k)
            report(self.label, k + 1, self.frames)

    @functools.cached_property
    def gif(self) -> bytes:
        """The film as a GIF file in memory; at most 50 frames per second are kept."""
        every = max(1, int(np.ceil(self.fps / _GIF_FPS - 1e-9)))
        return _gif(self, every)

    @property
    def png(self) -> bytes:
        """The first frame as a PNG file in memory."""
        return _png(self.draw(0))

    def save(self, path: str | Path) -> Path:
        """Write the film and return the path.

        Args:
            path: Ending in .webp, small and shown by every browser, or .gif; in .mp4, .mov,
                .mkv or .webm, which need the extra `view`; or a folder or a name ending in
                .png for numbered pictures.

        Raises:
            ValueError: If the ending is another one, or the extra is missing.
        """
        path = Path(path)
        kind = path.suffix.lower()
        if kind == ".gif":
            path.write_bytes(self.gif)
        elif kind == ".webp":
            _webp(self, path)
        elif kind in (".mp4", ".mov", ".mkv", ".webm"):
            _encode(self, path)
        elif kind in ("", ".png"):
            _numbered(self, path)
        else:
            raise ValueError(
                f"Film.save: the file name ends in `{kind}`, need .webp, .gif, .mp4, .webm, "
                ".png or a folder."
            )
        return path

    def _repr_png_(self) -> bytes:
        return self.png

    def _repr_html_(self) -> str:
        import base64

        data = base64.b64encode(self.gif).decode()
        return f'<img src="data:image/gif;base64,{data}" alt="film of {self.frames} frames">'


def animate_figure(
    figure: "Figure",
    update: Callable[[int], "Iterable[Artist]"],
    frames: int,
    *,
    fps: float = 20.0,
    label: str = "film",
) -> Film:
    """A film of a figure.

    What stands still is drawn once: only the artists that `update` returns are drawn
    for every frame, in their order.

    Args:
        figure: From `matplotlib.figure.Figure`, with everything in it.
        update: `update(k)` moves the artists of frame k and returns them; they must lie in
            axes.
        frames: Number of frames.
        fps: Frames per second.
        label: Name in the progress report.

    Returns:
        The film.
    """
    if frames < 1 or not 0 < fps <= 240:
        raise ValueError(
            f"animate: got {frames} frames at {fps:g} per second, need 1 or more at up to 240. "
            "Show every second frame."
        )
    return Film(renderer_of(figure, update), frames, fps, label)


def renderer_of(
    figure: "Figure", update: Callable[[int], "Iterable[Artist]"]
) -> Callable[[int], Frame]:
    """What draws frame k of a film of `animate_figure`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    for artist in update(0):
        artist.set_animated(True)
    canvas.draw()
    # The layout must not move under the parts that are kept.
    figure.set_layout_engine("none")
    canvas.draw()
    still = canvas.copy_from_bbox(figure.bbox)

    def render(k: int) -> Frame:
        canvas.restore_region(still)
        for artist in update(k):
            artist.set_animated(True)
            artist.draw(canvas.get_renderer())
        return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()

    return render


def _gif(film: Film, every: int) -> bytes:
    from PIL import Image

    count = len(range(0, film.frames, every))
    samples = np.unique(np.linspace(0, count - 1, _SAMPLES).astype(int)) * every
    palette = _palette([Image.fromarray(film.draw(int(k))) for k in samples])
    pictures = []
    for k in range(0, film.frames, every):
        picture = Image.fromarray(film.draw(k))
        pictures.append(picture.quantize(palette=palette, dither=Image.Dither.NONE))
        report(film.label, len(pictures), count)
    buffer = io.BytesIO()
    look = {"loop": 0, "optimize": False, "disposal": 1}
    length = round(100 * every / film.fps) * 10
    rest = pictures[1:]
    pictures[0].save(buffer, "GIF", save_all=True, append_images=rest, duration=length, **look)
    return buffer.getvalue()


def _webp(film: Film, path: Path) -> None:
    """Lossy, which shading takes; every frame for a whole number of milliseconds."""
    from PIL import Image

    first, *rest = (Image.fromarray(frame) for frame in film)
    look = {"quality": _QUALITY, "method": 4, "loop": 0, "duration": round(1000 / film.fps)}
    first.save(path, "WEBP", save_all=True, append_images=rest, **look)


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


def _encode(film: Film, path: Path) -> None:
    """By ffmpeg, H.264 in 4:2:0, which every player and browser takes."""
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ValueError(
            f"Film.save: {path.suffix} needs imageio-ffmpeg, which is not installed. Run "
            'pip install "sorojax[view]", or save a .gif.'
        )
    imageio_ffmpeg: Any = importlib.import_module("imageio_ffmpeg")
    high, wide = film.draw(0).shape[:2]
    size = (wide - wide % 2, high - high % 2)  # the format has pairs of pixels only
    look = {"codec": "libx264", "quality": 7}
    if path.suffix.lower() == ".webm":
        look = {"codec": "libvpx-vp9", "quality": None}
    look |= {"macro_block_size": 1, "pix_fmt_out": "yuv420p"}
    writer = imageio_ffmpeg.write_frames(str(path), size, fps=film.fps, **look)
    writer.send(None)
    try:
        for frame in film:
            writer.send(np.ascontiguousarray(frame[: size[1], : size[0]]))
    finally:
        writer.close()


def _numbered(film: Film, path: Path) -> None:
    """NAME_0000.png and so on, or frame_0000.png in a folder."""
    folder, stem = (path.parent, path.stem) if path.suffix else (path, "frame")
    folder.mkdir(parents=True, exist_ok=True)
    for k, frame in enumerate(film):
        (folder / f"{stem}_{k:04d}.png").write_bytes(_png(frame))


def _png(frame: Frame) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, "PNG")
    return buffer.getvalue()


def frames_at(
    time: Float[np.ndarray, " time"], fps: float, speed: float = 1.0
) -> Int[np.ndarray, " frames"]:
    """Samples of `time` nearest to the instants of a film that runs at `speed` times real
    time; 0.1 is slow motion."""
    if time.ndim != 1 or len(time) < 1 or np.any(np.diff(time) <= 0):
        raise ValueError(
            f"film: `time` has shape {time.shape} and must rise strictly. Give the instants of "
            "the frames [s]."
        )
    if not 0 < speed < np.inf or not 0 < fps <= 240:
        raise ValueError(
            f"film: got speed={speed:g} at {fps:g} frames per second, need a positive speed "
            "and up to 240 frames. 1 is real time, 0.1 slow motion."
        )
    count = int(np.floor((time[-1] - time[0]) * fps / speed + 1e-9)) + 1
    wanted = time[0] + np.arange(count) * speed / fps
    right = np.clip(np.searchsorted(time, wanted), 1, max(len(time) - 1, 1))
    right = np.minimum(right, len(time) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(wanted - time[left] <= time[right] - wanted, left, right)
