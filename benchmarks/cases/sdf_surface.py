"""Surface of a solid of five primitives on 512^3 cells, against scikit-image, fogleman/sdf."""

import functools
import time
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import peers
from benchmarks.harness import Row, quick
from benchmarks.memory import forget_peak, resident
from sorojax import sdf
from sorojax.sdf.base import AbstractSdf, cast, minimum, norm

CELLS, SIDE = 512, 2.2  # along the cube, and its edge in m
METHODS: tuple[Literal["marching_cubes", "dual_contouring"], ...] = (
    "marching_cubes",
    "dual_contouring",
)
REFERENCE = "rms |f| at triangle centres in cells"


class CrossedRods(AbstractSdf):
    """Three endless rods of `radius` [m] along the axes."""

    radius: jax.Array

    @property
    def dim(self):
        return 3

    def distance(self, x, y, z):
        return minimum(minimum(norm(x, y), norm(y, z)), norm(z, x)) - self.radius

    def bounding_box(self):
        return jnp.full(3, -jnp.inf), jnp.full(3, jnp.inf)


def solid() -> AbstractSdf:
    """Ball and box less three rods."""
    ball = sdf.Sphere([0.0, 0.0, 0.0], 1.0) & sdf.Box([-0.75] * 3, [0.75] * 3)
    return ball - CrossedRods(jnp.asarray(0.5, jnp.result_type(float)))


@eqx.filter_jit
def _layer(shape, x, axis):
    """Field in float32 on one layer of the grid."""
    at = (x[:, None, None], axis[None, :, None], axis[None, None, :])
    return cast(shape, jnp.dtype("float32")).distance(*at)[0]


def dense(shape: AbstractSdf, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Every node of the grid in one array, then scikit-image."""
    from skimage import measure

    axis = jnp.asarray(np.linspace(-SIDE / 2, SIDE / 2, cells + 1), dtype=jnp.float32)
    field = np.empty((cells + 1,) * 3, np.float32)
    for i in range(cells + 1):
        field[i] = _layer(shape, axis[i : i + 1], axis)
    vertices, triangles, *_ = measure.marching_cubes(field, 0.0)
    return vertices * (SIDE / cells) - SIDE / 2, triangles


def measured(function, repeats: int = 2 if quick() else 3) -> tuple[list[float], float, Any]:
    """Seconds of every run, peak memory [MB] of the last one, and its result."""
    runs, peak, result = [], 0.0, None
    for _ in range(repeats):
        del result
        forget_peak()
        before, start = resident("VmRSS"), time.perf_counter()
        result = function()
        runs.append(time.perf_counter() - start)
        peak = resident("VmHWM") - before
    return sorted(runs), peak, result


def rms(shape: AbstractSdf, vertices, triangles) -> float:
    from sorojax.sdf.sampling import values

    chosen = triangles[:: max(1, len(triangles) // 200_000)]
    f = values(shape, np.asarray(vertices, dtype=float)[chosen].mean(axis=1))
    return float(np.sqrt((f * f).mean())) * CELLS / SIDE


def rows():
    shape = solid()
    dense(shape, 32)
    runs, peak, (vertices, triangles) = measured(lambda: dense(shape, CELLS))
    error = rms(shape, vertices, triangles)
    del vertices, triangles
    yield _row("scikit-image", {"method": "every cell"}, runs, peak, error)
    for method in METHODS:
        sdf.isosurface(shape, SIDE / 32, method)
        ours, memory, surface = measured(
            functools.partial(sdf.isosurface, shape, SIDE / CELLS, method)
        )
        settings = {
            "method": method,
            "time_ratio": ours[len(ours) // 2] / runs[len(runs) // 2],
            "memory_ratio": memory / peak,
        }
        found = rms(shape, *surface)
        del surface
        if method == "dual_contouring":  # asked for: a fifth of the error
            bar = {"bar": error / 5, "bar_on": "error"}
        else:
            bar = {"bar": 0.5 * runs[len(runs) // 2]}
        yield _row("sorojax", settings, ours, memory, found, **bar)

    def error_of(arrays):
        corners = arrays["corners"]
        return rms(shape, corners, np.arange(len(corners)).reshape(-1, 3))

    if not quick("sdf_fork: it is in sdf.value"):
        yield peers.row(
            "sdf_fork", "surface", {}, error_of, REFERENCE, side=SIDE, cells=CELLS, repeats=1
        )


def _row(code, settings, runs, peak, error, **bar) -> Row:
    return Row(
        code,
        {"cells": CELLS, "peak_MB": peak, **settings},
        run_s=runs[len(runs) // 2],
        run_s_min=runs[0],
        run_s_max=runs[-1],
        error=error,
        reference=REFERENCE,
        **bar,
    )
