"""Field of a solid of five primitives at 2^20 points, against NumPy and fogleman/sdf."""

import statistics

import numpy as np

from benchmarks import peers
from benchmarks.csg import POINTS, in_numpy, in_numpy_nodes, points, solid
from benchmarks.harness import Row, measure_calls
from sorojax import sdf

# Million points per second, and times as fast as the same tree in NumPy.
BARS = {"float32": (400, 30), "float64": (150, 15)}
PEERS = {"node by node": in_numpy_nodes, "written out by hand": in_numpy}


def rows():
    import jax.numpy as jnp

    shape = solid()
    for dtype, (rate, ratio) in BARS.items():
        p = points(dtype)
        held = jnp.asarray(p)
        theirs = {
            name: measure_calls(lambda form=form, p=p: form(p)) for name, form in PEERS.items()
        }
        ours = measure_calls(lambda held=held: sdf.evaluate(shape, held), repeats=51)
        seconds = {name: statistics.median(timing.runs) for name, timing in theirs.items()}
        exact = in_numpy(p.astype("float64"))
        error = float(np.abs(np.asarray(sdf.evaluate(shape, held)) - exact).max())
        times = {
            f"times as fast as NumPy {name}": run / statistics.median(ours.runs)
            for name, run in seconds.items()
        }
        yield Row(
            "sorojax",
            {"points": POINTS, "method": dtype, **times},
            **ours.columns(),
            error=error,
            reference="NumPy in float64",
            bar=min(POINTS / rate / 1e6, seconds["node by node"] / ratio),
        )
        for name, form in PEERS.items():
            error = float(np.abs(form(p) - exact).max())
            settings = {"points": POINTS, "method": f"{dtype}, {name}"}
            yield Row("numpy", settings, **theirs[name].columns(), error=error, reference="")
    p = points("float64")
    exact = in_numpy(p)
    yield peers.row(
        "sdf_fork",
        "value",
        {"points": p},
        lambda arrays: float(np.abs(arrays["field"] - exact).max()),
        "NumPy in float64",
        method="float64",
        repeats=5,
    )
