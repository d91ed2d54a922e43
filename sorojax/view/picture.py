"""What `show` returns: a figure that a notebook displays and that can be written."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sorojax.view import style
from sorojax.view.raster.camera import Lens

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_KINDS = (".png", ".pdf", ".svg", ".jpg", ".jpeg", ".webp")


@dataclass(frozen=True, eq=False)
class Panel:
    """One drawing in a picture: its axes, and the lens if it is solid."""

    axes: "Axes"
    lens: Lens | None = None


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure of matplotlib with what is needed to write it and to find points in it."""

    figure: "Figure"
    panels: tuple[Panel, ...] = field(default=(), repr=False)

    def save(self, path: str | Path, *, dpi: float | None = None) -> Path:
        """Write the picture; the ending gives the format. PDF and SVG hold vectors.

        Args:
            path: Ending in .png, .pdf, .svg, .jpg or .webp.
            dpi: Dots per inch; those of the figure if omitted.

        Raises:
            ValueError: If the ending is another one.
        """
        path = Path(path)
        if path.suffix.lower() not in _KINDS:
            raise ValueError(
                f"Picture.save: the file name ends in `{path.suffix}`, need one of "
                f"{', '.join(_KINDS)}. A film is saved as .mp4 or .gif."
            )
        metadata = {"Date": None} if path.suffix.lower() == ".svg" else None
        self.figure.savefig(path, dpi=dpi or self.figure.dpi, metadata=metadata)
        return path

    @property
    def png(self) -> bytes:
        """The picture as a PNG file in memory."""
        return style.png(self.figure)

    def pixels(
        self, points: Float[Any, "points dim"], panel: int = 0
    ) -> Float[Any, "points 2"]:
        """Where `points` [m] are in the PNG: pixels to the right and down."""
        self.figure.canvas.draw()  # the layout is known only then
        drawn, points = self.panels[panel], np.asarray(points, float)
        flat = 1e3 * points if drawn.lens is None else drawn.lens(points)[:, :2]
        at = drawn.axes.transData.transform(flat)
        high = self.figure.get_size_inches()[1] * self.figure.dpi
        return np.stack([at[:, 0], high - at[:, 1]], axis=1)

    def _repr_png_(self) -> bytes:
        return self.png

    def _repr_html_(self) -> None:
        return None  # a notebook takes the PNG

    def __repr__(self) -> str:
        wide, high = self.figure.get_size_inches() * self.figure.dpi
        return f"Picture: {wide:.0f} x {high:.0f} pixels; .save('name.png'), .figure"


Drawn = Callable[..., Picture]
