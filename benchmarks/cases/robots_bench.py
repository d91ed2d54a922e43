"""The printable robots as networks behind a board: what a simulated second costs.

Each in a process of its own, as `sorojax-bench serve --robot` starts it: with one thread for
linear algebra, whose systems are small.
"""

import json
import os
import subprocess
import sys
import time

import numpy as np

from benchmarks.harness import Row
from sorojax_hardware import LocalBoard, SimulatedClock, run_loop, simulated
from sorojax_hardware.desk import ROBOTS

DURATION, PERIOD = 2.0, 0.01
BAR = 1.0  # seconds per simulated second: real time


def rows():
    for robot in ROBOTS:
        code = "import sys; from benchmarks.cases.robots_bench import told; told(sys.argv[1])"
        own = {"OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
        run = subprocess.run(
            [sys.executable, "-c", code, robot],
            check=True,
            text=True,
            stdout=subprocess.PIPE,
            env=os.environ | own,
        )
        yield _row(robot, **json.loads(run.stdout.splitlines()[-1]))


def _row(robot: str, first, run, ports, off, state) -> Row:
    settings = {"robot": robot, "ports": ports, "off_setpoint": off, "real_time": run < BAR}
    return Row(
        "sorojax",
        settings,
        first,
        run,
        run,
        run,
        error=float(state != "VENTED"),
        bar=BAR,
        reference="CPU seconds per simulated second; error: the board tripped",
    )


def told(robot: str) -> None:
    """Print what `rows` needs to know of a robot, in a process of its own."""
    start = time.perf_counter()
    valves, settings = simulated(robot)
    first = time.perf_counter() - start
    clock = SimulatedClock()
    board = LocalBoard(settings, valves, clock)
    board.arm()
    low, high = np.array([(one.low, one.high) for one in settings.limits]).T

    def wave(t, pressure, state):
        phase = np.arange(len(high))
        return 0.5 * high * (1 - np.cos(2 * np.pi * t + 0.5 * phase)), state

    start, late = time.process_time(), []
    for tick in run_loop(
        board, clock, wave, None, duration=DURATION, period=PERIOD, limits=(low, high)
    ):
        late.append(float(np.max(np.abs(tick.pressure - tick.setpoint))))
    run = (time.process_time() - start) / DURATION
    found = {
        "first": first,
        "run": run,
        "ports": len(high),
        "off": max(late),
        "state": board.board.state.name,
    }
    print(json.dumps(found))
