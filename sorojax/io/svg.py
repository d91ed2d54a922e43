"""SVG: curves of a plane shape, in millimetres."""

from collections.abc import Sequence
from typing import BinaryIO

import numpy as np

from sorojax.sdf import Curve


def write(file: BinaryIO, curves: Sequence[Curve]) -> None:
    """One path; y points up, holes stay empty, one user unit is 1 mm."""
    every = 1e3 * np.concatenate([curve.points for curve in curves])
    low, high = every.min(axis=0), every.max(axis=0)
    width, height = high - low
    path = " ".join(_path(1e3 * curve.points, curve.closed) for curve in curves)
    text = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.9g}mm" '
        f'height="{height:.9g}mm" viewBox="{low[0]:.9g} {-high[1]:.9g} {width:.9g} '
        f'{height:.9g}">\n<path fill="#888" fill-rule="evenodd" d="{path}"/>\n</svg>\n'
    )
    file.write(text.encode())


def _path(points: np.ndarray, closed: bool) -> str:
    steps = " L".join(f"{x:.9g} {-y:.9g}" for x, y in points)
    return f"M{steps}" + ("Z" if closed else "")
