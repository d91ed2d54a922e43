"""Frames of a film of 640x480 pixels: seconds each of a bending beam coloured by a field, by
sorojax's own renderer and by pyvista, at 10 frames/s or more."""

import importlib.util
import time

import numpy as np

from benchmarks.harness import Row, Timing, missing
from sorojax import mesh, view
from sorojax.view.film.tracks import positions_track

FRAMES, SIZE, BAR = 30, (640, 480), 1 / 10
LENGTH = 0.06  # m


DIVISIONS = (60, 12, 12)
TRIANGLES = 2 * (4 * 60 * 12 + 2 * 12 * 12)


def film(renderer: str):
    """A beam of 60 x 12 x 12 cells that bends to half a turn."""
    body = mesh.box([0, 0, 0], [LENGTH, 0.012, 0.012], divisions=DIVISIONS)
    x, y, z = np.asarray(body.points).T
    instants = np.linspace(0, 1, FRAMES)
    kappa = (np.pi / LENGTH) * instants[:, None] + 1e-6
    angle = kappa * x
    places = np.stack(
        [
            (1 / kappa - z) * np.sin(angle),
            np.broadcast_to(y, angle.shape),
            1 / kappa - (1 / kappa - z) * np.cos(angle),
        ],
        axis=2,
    )
    strain = 100 * np.abs(kappa * z)
    track = positions_track(body, places, instants, field=strain, label="strain [%]")
    return view.animate(track, fps=FRAMES - 1, renderer=renderer, size=SIZE)


def seconds(made) -> Timing:
    """The first frame, and each of the others."""
    runs = []
    for k in range(made.frames):
        start = time.perf_counter()
        made.draw(k)
        runs.append(time.perf_counter() - start)
    return Timing(runs[0], tuple(runs[1:]))


def rows():
    for renderer in ("own", "pyvista"):
        settings = {"renderer": renderer, "pixels": "640x480", "triangles": TRIANGLES}
        if renderer == "pyvista" and importlib.util.find_spec("pyvista") is None:
            yield missing("pyvista", "pyvista is not installed", **settings)
            continue
        timing = seconds(film(renderer))
        yield Row("sorojax", settings, **timing.columns(), bar=BAR)
