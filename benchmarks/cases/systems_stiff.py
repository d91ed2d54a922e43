"""Regulated finger, fastest eigenvalue 5e4 1/s, one second: time to an error of 2e-7."""

import diffrax as dfx
import jax
import numpy as np

from benchmarks.harness import Row, measure_together
from benchmarks.regulated import error, reference, regulated, solver_run
from sorojax.math.ode.rosenbrock import Rodas4
from sorojax.math.ode.step_control import Control

GAIN = 1000.0
WANTED = 2e-7  # relative error of the modes at 1 s
RATIO = 5.0  # of diffrax to Rodas4
LADDER = (3e-6, 1e-6, 7e-7, 5e-7, 3e-7)  # relative tolerances


def first_good(make, network, want):
    """The loosest tolerance of the ladder whose error is as wanted, and what it gave."""
    at = jax.jit(lambda rtol, network: make(rtol)(network))  # one program for all of them
    for rtol in LADDER:
        end, steps = at(rtol, network)
        got = error(end, want)
        if got <= WANTED:
            return rtol, make(rtol), got, int(np.asarray(steps))
    raise RuntimeError(f"no tolerance of {LADDER} reaches {WANTED}")


def rows():
    network, want = regulated(GAIN), reference(GAIN)
    makes = {
        "Kvaerno3": lambda r: solver_run(
            dfx.Kvaerno3(), dfx.PIDController(rtol=r, atol=r / 100)
        ),
        "Rodas4": lambda r: solver_run(Rodas4(), Control(r, r / 100)),
    }
    found = {name: first_good(make, network, want) for name, make in makes.items()}
    times = measure_together({k: f[1] for k, f in found.items()}, network, repeats=5)
    bar = times["Kvaerno3"].columns()["run_s"] / RATIO
    for name, timing in times.items():
        rtol, _, got, steps = found[name]
        own = name == "Rodas4"
        yield Row(
            "sorojax" if own else "diffrax",
            {"method": name, "gain": GAIN, "rtol": rtol, "steps": steps},
            **timing.columns(),
            error=got,
            reference="Radau of SciPy to 1e-11, modes at 1 s",
            bar=bar if own else None,
        )
