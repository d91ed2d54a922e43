"""Field of a solid of five primitives at 2^20 points, against NumPy."""

import numpy as np

from benchmarks.csg import POINTS, in_numpy, points, solid
from benchmarks.harness import Row, measure_calls
from sorojax import sdf

BARS = {"float32": 400, "float64": 150}  # million points per second


def rows():
    import jax.numpy as jnp

    shape = solid()
    for dtype, rate in BARS.items():
        p = points(dtype)
        settings = {"points": POINTS, "method": dtype}
        held = jnp.asarray(p)
        ours = measure_calls(lambda held=held: sdf.evaluate(shape, held), repeats=15)
        theirs = measure_calls(lambda p=p: in_numpy(p))
        exact = in_numpy(p.astype("float64"))
        error = float(np.abs(np.asarray(sdf.evaluate(shape, held)) - exact).max())
        yield Row(
            "sorojax", settings, **ours.columns(), error=error, reference="NumPy in float64",
            bar=POINTS / rate / 1e6,
        )  # fmt: skip
        error = float(np.abs(in_numpy(p) - exact).max())
        yield Row("numpy", settings, **theirs.columns(), error=error, reference="")
