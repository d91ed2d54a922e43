"""Moving surfaces to GLB files, for Blender, viewers on the web and slides."""

import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sorojax import _check
from sorojax.io import _files, glb_animation
from sorojax.io.glb_animation import MovingSurface


def export_animation(
    path: str | os.PathLike,
    shapes: Sequence[MovingSurface],
    times: Float[np.ndarray, " frames"],
    *,
    root: str | os.PathLike | None = None,
) -> None:
    """Write moving surfaces as GLB, whole or not at all.

    A surface that changes shape has one morph target per frame, one that moves rigidly a
    pose per frame. `view.to_glb` makes the shapes from results.

    Args:
        path: File name, ending in .glb.
        shapes: The surfaces [m].
        times: Instants of the frames, rising [s].
        root: Folder that the file must lie in, links followed.

    Raises:
        ValueError: If the ending is another, a number of frames does not fit, numbers are
            not finite or times do not rise.
    """
    where = "export_animation"
    file = _files.inside(where, path, root)
    if file.suffix.lower() != ".glb":
        raise ValueError(f"{where}: the file name ends in `{file.suffix}`, need .glb.")
    times = np.asarray(times, float)
    if times.ndim != 1 or np.any(np.diff(times) <= 0) or not len(shapes):
        raise ValueError(
            f"{where}: got {len(shapes)} shapes and times of shape {times.shape}, need one "
            "shape or more and times that rise strictly."
        )
    _check.finite(where, "times", times, "Give seconds.")
    for shape in shapes:
        _check.finite(where, "points", shape.points, "Cut the motion where it failed.")
        counts = {len(part) for part in (shape.points, shape.poses) if part is not None}
        if counts - {1, len(times)}:
            raise ValueError(
                f"{where}: `{shape.name}` has {sorted(counts)} frames, need {len(times)} or 1. "
                "Give one time per frame."
            )
    _files.write(file, lambda stream: glb_animation.write(stream, shapes, times))
