"""A closed loop on the simulated board, over loopback, at a fixed rate for a minute."""

import os
import subprocess
import sys

import numpy as np

from benchmarks.harness import Row
from sorojax_hardware import TcpBoard, WallClock, deadlines, run_loop

RATE, DURATION = 200.0, 60.0
BAR = 1e-3  # s, the 99th percentile of the error of a period


def rows():
    """The board is a process of its own, as on the bench; both share the machine's cores."""
    child = subprocess.Popen(
        [sys.executable, "-m", "sorojax_board", "--port", "0"],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        port = int(child.stdout.readline().rsplit(":", 1)[1])  # type: ignore[union-attr]
        yield _loop(port)
    finally:
        child.terminate()
        child.wait()


def _loop(port: int) -> Row:
    def controller(t, pressure, integral):
        error = 20e3 * (1 + np.sin(2 * np.pi * t)) - pressure
        integral = integral + error / RATE
        return 0.3 * error + 8.0 * integral, integral

    with TcpBoard(port=port, timeout=1.0) as board:
        board.arm((-10e3, 60e3))
        ticks = list(
            run_loop(
                board, WallClock(), controller, np.zeros(board.num_ports),
                duration=DURATION, period=1 / RATE, limits=(0.0, 50e3),
            )
        )  # fmt: skip
        refused, state = board.report.refused, board.report.state.name
    report = deadlines(ticks, 1 / RATE)
    error = np.abs(np.diff([tick.time for tick in ticks]) - 1 / RATE)
    settings = {
        "rate": RATE, "duration": DURATION, "ticks": report.num_ticks,
        "left_out": report.num_skipped, "refused": refused, "board": state,
        "load": os.getloadavg()[0], "p50_period_error": float(np.median(error)),
    }  # fmt: skip
    return Row(
        "sorojax", settings, 0.0, float(np.percentile(error, 99)), float(error.min()),
        float(error.max()), error=float(report.num_skipped + refused), bar=BAR,
        reference="99th percentile of the error of a period; error: samples lost",
    )  # fmt: skip
