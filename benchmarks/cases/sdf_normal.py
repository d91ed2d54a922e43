"""Field and exact unit normal of a solid of five primitives at 2^20 points."""

import numpy as np

from benchmarks.csg import POINTS, in_numpy, points, solid
from benchmarks.harness import Row, measure_calls
from sorojax import sdf
from sorojax.sdf.query import value_and_normal_at

STEP = 1e-6
RATE = 80  # million points per second in float32


def by_differences(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Field and normal by forward differences."""
    f = in_numpy(p)
    moved = [in_numpy(p + STEP * np.eye(3)[i]) for i in range(3)]
    g = np.stack([(m - f) / STEP for m in moved], axis=-1)
    return f, g / np.linalg.norm(g, axis=1, keepdims=True)


def exact_normal(p: np.ndarray) -> np.ndarray:
    """The slope of the part that decides the field."""
    x, y, z = p.T
    ball = p / np.linalg.norm(p, axis=1, keepdims=True)
    out = np.maximum(np.abs(p) - 0.75, 0)
    face = np.eye(3)[np.argmax(np.abs(p), axis=1)]
    corner = np.where((out > 0).any(axis=1, keepdims=True), out, face)
    cube = np.sign(p) * corner / np.linalg.norm(corner, axis=1, keepdims=True)
    axis = np.argmin([y * y + z * z, x * x + z * z, x * x + y * y], axis=0)
    across = p * (1 - np.eye(3)[axis])
    bore = -across / np.linalg.norm(across, axis=1, keepdims=True)
    a, b, c = np.abs(p).T - 0.75
    depth = np.minimum(np.maximum(a, np.maximum(b, c)), 0)
    fields = np.stack(
        [
            np.linalg.norm(p, axis=1) - 1,
            depth + np.linalg.norm(out, axis=1),
            0.5 - np.linalg.norm(across, axis=1),
        ]
    )
    return np.choose(np.argmax(fields, axis=0)[:, None], [ball, cube, bore])


def apart(p):
    """One array per coordinate."""
    import jax.numpy as jnp

    return tuple(jnp.asarray(np.ascontiguousarray(c)) for c in p.T)


def rows():
    import jax.numpy as jnp

    shape = solid()
    doors = {
        "one array per coordinate": (apart, value_and_normal_at),
        "one row per point": (jnp.asarray, sdf.value_and_normal),
    }
    for dtype in ("float32", "float64"):
        p = points(dtype)
        exact = exact_normal(p.astype("float64"))
        for name, (form, verb) in doors.items():
            held = form(p)
            timing = measure_calls(lambda verb=verb, x=held: verb(shape, x), repeats=15)
            found = verb(shape, held)[1]
            found = np.stack(found, axis=-1) if isinstance(found, tuple) else np.asarray(found)
            # Rounding decides between two faces at an edge: those points do not count.
            error = float(np.quantile(np.abs(found - exact), 0.9999))
            yield Row(
                "sorojax",
                {"points": POINTS, "method": f"{dtype}, {name}"},
                **timing.columns(),
                error=error,
                reference="closed form",
                bar=POINTS / RATE / 1e6 if dtype == "float32" else None,
            )
    p = points("float64")
    timing = measure_calls(lambda: by_differences(p))
    error = float(np.quantile(np.abs(by_differences(p)[1] - exact_normal(p)), 0.9999))
    settings = {"points": POINTS, "method": "forward differences"}
    yield Row("numpy", settings, **timing.columns(), error=error, reference="closed form")
