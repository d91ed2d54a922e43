"""Regulated finger, fastest eigenvalue 5e2 1/s, one second: the explicit method, unrolled.

Both methods take the same steps, under the same control. By `jax.jit`, and ours by
`sorojax.jit`, which makes one kernel of its loop; that of diffrax's stages it leaves as it is.
"""

import functools

import diffrax as dfx
import jax
import numpy as np

from benchmarks.cases.rod_batch import in_turns
from benchmarks.harness import Row
from benchmarks.regulated import error, reference, regulated, solver_run
from sorojax import jit
from sorojax.math.ode.explicit import Tsit5

GAIN, RTOL = 10.0, 1e-6
RATIO = 3.0  # of diffrax to the unrolled method


def rows():
    network = regulated(GAIN)
    want = reference(GAIN)
    control = dfx.PIDController(rtol=RTOL, atol=RTOL / 100)
    stock, own = (solver_run(solver, control) for solver in (dfx.Tsit5(), Tsit5()))
    compiled = {"diffrax": jax.jit(stock), "sorojax": jax.jit(own), "sorojax.jit": jit(own)}
    programs = {name: functools.partial(run, network) for name, run in compiled.items()}
    times = in_turns(programs, repeats=9)
    ends = {name: run() for name, run in programs.items()}
    counts = {name: int(np.asarray(end[1])) for name, end in ends.items()}
    if len(set(counts.values())) > 1:
        raise RuntimeError(f"the steps differ: {counts}")
    bar = times["diffrax"].columns()["run_s"] / RATIO
    for name, timing in times.items():
        code = name.removesuffix(".jit")
        by = "jax.jit" if name == code else name
        yield Row(
            code,
            {"method": "Tsit5", "gain": GAIN, "steps": counts[name], "by": by},
            **timing.columns(),
            error=error(ends[name][0], want),
            reference="Radau of SciPy to 1e-11, modes at 1 s",
            bar=bar if code == "sorojax" else None,
        )
