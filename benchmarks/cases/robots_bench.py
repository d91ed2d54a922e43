"""The printable robots as networks behind a board: what a simulated second costs."""

import time

import numpy as np

from benchmarks.harness import Row
from sorojax_hardware import LocalBoard, SimulatedClock, run_loop, simulated
from sorojax_hardware.desk import ROBOTS

DURATION, PERIOD = 2.0, 0.01
BAR = 1.0  # seconds per simulated second: real time


def rows():
    for robot in ROBOTS:
        start = time.perf_counter()
        valves, settings = simulated(robot)
        first = time.perf_counter() - start
        clock = SimulatedClock()
        board = LocalBoard(settings, valves, clock)
        board.arm()
        low, high = np.array([(one.low, one.high) for one in settings.limits]).T

        def wave(t, pressure, state, high=high):
            phase = np.arange(len(high))
            return 0.5 * high * (1 - np.cos(2 * np.pi * t + 0.5 * phase)), state

        start, late = time.process_time(), []
        for tick in run_loop(board, clock, wave, None, duration=DURATION, period=PERIOD,
                             limits=(low, high)):  # fmt: skip
            late.append(np.max(np.abs(tick.pressure - tick.setpoint)))
        run = (time.process_time() - start) / DURATION
        yield Row(
            "sorojax", {"robot": robot, "ports": len(high), "off_setpoint": max(late)}, first,
            run, run, run, error=float(board.board.state.name != "VENTED"), bar=BAR,
            reference="CPU seconds per simulated second; error: the board tripped",
        )  # fmt: skip
