"""Regulated finger, fastest eigenvalue 5e2 1/s, one second: the explicit method, unrolled.

Both methods take the same steps, under the same control.
"""

import diffrax as dfx
import numpy as np

from benchmarks.harness import Row, measure_together
from benchmarks.regulated import error, reference, regulated, solver_run
from sorojax.math.explicit import Tsit5

GAIN, RTOL = 10.0, 1e-6
RATIO = 3.0  # of diffrax to the unrolled method


def rows():
    network = regulated(GAIN)
    want = reference(GAIN)
    control = dfx.PIDController(rtol=RTOL, atol=RTOL / 100)
    solvers = {"diffrax": dfx.Tsit5(), "sorojax": Tsit5()}
    runs = {name: solver_run(solver, control) for name, solver in solvers.items()}
    ends = {}
    times = measure_together(runs, network, repeats=9, results=ends)
    counts = {name: int(np.asarray(end[1])) for name, end in ends.items()}
    if counts["diffrax"] != counts["sorojax"]:
        raise RuntimeError(f"the steps differ: {counts}")
    bar = times["diffrax"].columns()["run_s"] / RATIO
    for name, timing in times.items():
        yield Row(
            name, {"method": "Tsit5", "gain": GAIN, "steps": counts[name]},
            **timing.columns(), error=error(ends[name][0], want),
            reference="Radau of SciPy to 1e-11, modes at 1 s",
            bar=bar if name == "sorojax" else None,
        )  # fmt: skip
