"""A closed loop on the simulated board, over loopback, at a fixed rate for a minute, with the
shape of a frame of markers estimated in every tick."""

import os
import subprocess
import sys
from pathlib import Path
from time import process_time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row
from sorojax.math.lie import SE2
from sorojax.rod import chebyshev, circle, forward_kinematics, rod
from sorojax.systems import Markers, estimate_shape
from sorojax_hardware import TcpBoard, WallClock, deadlines, run_loop

RATE, DURATION = 200.0, 60.0
BAR = 1e-3  # s, the 99th percentile of the error of a period
S = jnp.array([0.25, 0.5, 0.75, 1.0])
STAT = Path("/proc/stat")


def rows():
    """The board is a process of its own, as on the bench; both share the machine's cores."""
    command = [sys.executable, "-m", "sorojax_board", "--port", "0"]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        port = int(child.stdout.readline().rsplit(":", 1)[1])  # type: ignore[union-attr]
        yield _loop(port)
    finally:
        child.terminate()
        child.wait()


def _estimator():
    """Markers of a bent finger, frame by frame, and the compiled estimate."""
    finger = rod(
        SE2(),
        chebyshev(kappa_z=3),
        circle(6e-3),
        length=0.08,
        young_modulus=1e6,
        poisson_ratio=0.3,
        density=1100.0,
        nodes=8,
    )
    markers = Markers(finger, S)
    bends = 12 * np.sin(np.linspace(0, 2 * np.pi, 64))
    frames = [
        forward_kinematics(finger, jnp.array([bend, bend / 3, 0.0]), S)[:, :2, 2]
        for bend in bends
    ]
    estimate = jax.jit(lambda seen, q: estimate_shape(markers, seen, q).q)
    jax.block_until_ready(estimate(frames[0], jnp.zeros(3)))
    return estimate, frames


def _loop(port: int) -> Row:
    estimate, frames = _estimator()

    def controller(t, pressure, state):
        tick, q, integral = state
        q = jax.block_until_ready(estimate(frames[tick % len(frames)], q))
        error = 20e3 * (1 + np.sin(2 * np.pi * t)) - pressure
        integral = integral + error / RATE
        return 0.3 * error + 8.0 * integral, (tick + 1, q, integral)

    with TcpBoard(port=port, timeout=1.0) as board:
        board.arm((-10e3, 60e3))
        start = (0, jnp.zeros(3), np.zeros(board.num_ports))
        before, spent = _processors(), process_time()
        ticks = list(
            run_loop(
                board,
                WallClock(),
                controller,
                start,
                duration=DURATION,
                period=1 / RATE,
                limits=(0.0, 50e3),
            )
        )
        used, spent = _used(before), process_time() - spent
        refused, late, state = board.report.refused, board.late, board.report
    report = deadlines(ticks, 1 / RATE)
    error = np.abs(np.diff([tick.time for tick in ticks]) - 1 / RATE)
    settings = {
        "rate": RATE, "duration": DURATION, "needs": "two free cores", **used,
        "cores_of_the_loop": spent / DURATION, "load": os.getloadavg()[0],
        "ticks": report.num_ticks, "left_out": report.num_skipped,
        "made_up": report.num_behind, "max_late": report.max_late, "late_set_points": late,
        "board": f"{state.state.name.lower()}, fault {state.fault!r}",
        "p50_period_error": float(np.median(error)),
    }  # fmt: skip
    return Row(
        "sorojax",
        settings,
        0.0,
        float(np.percentile(error, 99)),
        float(error.min()),
        float(error.max()),
        error=float(report.num_skipped + refused),
        bar=BAR,
        reference="99th percentile of the error of a period; error: samples lost",
    )


def _processors() -> np.ndarray | None:
    """Ticks of all processors so far: at work, idle, taken by other virtual machines."""
    if not STAT.exists():
        return None
    told = [int(word) for word in STAT.read_text().split("\n", 1)[0].split()[1:9]]
    user, nice, system, idle, waiting, hard, soft, stolen = told
    return np.array([user + nice + system + hard + soft, idle + waiting, stolen], float)


def _used(before: np.ndarray | None) -> dict[str, float]:
    """Cores at work since then, loop and board among them, and cores taken away."""
    now = _processors()
    if now is None or before is None:
        return {}
    share = (now - before) / np.sum(now - before) * (os.cpu_count() or 1)
    return {"cores": os.cpu_count() or 1, "busy": float(share[0]), "stolen": float(share[2])}
