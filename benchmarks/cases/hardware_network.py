"""A client, a network or a server that fails in mid-run: seconds until the board is at zero."""

import contextlib
import subprocess
import sys
import threading
import time
from statistics import median

import numpy as np

from benchmarks.harness import Row
from sorojax_board.bench import BenchValves
from sorojax_board.board import settings
from sorojax_hardware import BoardFault, DisturbedLink, TcpBoard, serve

TIMES, NEAR, BAR = 5, 0.5e3, 0.6  # runs, Pa that count as zero, s
CLIENT = """
import sys, time, numpy as np
from sorojax_hardware import TcpBoard
board = TcpBoard(port=int(sys.argv[1]), timeout=1.0)
board.arm()
while True:
    board.write_pressure(np.full(2, 50e3))
    time.sleep(0.005)
"""


def rows():
    for kind in (
        "client killed",
        "network cut",
        "network frozen",
        "network delayed",
        "server ended",
    ):
        found = [_once(kind) for _ in range(TIMES)]
        took = [seconds for seconds, _ in found]
        told = sorted({reason for _, reason in found})
        yield Row(
            "sorojax",
            {"failure": kind, "runs": TIMES, "told": told},
            0.0,
            median(took),
            min(took),
            max(took),
            error=max(took),
            bar=BAR,
            bar_on="error",
            reference="from the failure to 0.5 kPa, worst run [s]",
        )


def _once(kind: str) -> tuple[float, str]:
    """Seconds from the failure until all pressures are near zero, and the board's reason."""
    valves = BenchValves(2, noise=0.0)
    limits = settings(2, low=-10e3, high=60e3)
    if kind == "server ended":
        with serve(limits, valves) as server:
            board = TcpBoard(port=server.port)
            _drive(board, valves)
            start = time.monotonic()
        # the set-points are zero when the server is gone; the valves follow by themselves
        took = time.monotonic() - start
        assert valves._written == (0.0, 0.0)
        return took, _said(board)
    with serve(limits, valves) as server, DisturbedLink(server.port) as link:
        if kind == "client killed":
            child = subprocess.Popen([sys.executable, "-c", CLIENT, str(link.port)])
            _wait(lambda: valves.pressure[0] > 49e3)
            start = time.monotonic()
            child.kill()
            child.wait()
        else:
            board = TcpBoard(port=link.port, timeout=0.2)
            _drive(board, valves)
            threading.Thread(target=_keep, args=(board,), daemon=True).start()
            time.sleep(0.1)
            start = time.monotonic()
            if kind == "network delayed":
                link.delay = 0.4
            else:
                link.cut() if kind == "network cut" else link.freeze()
        _wait(lambda: max(map(abs, valves.pressure)) < NEAR)
        took = time.monotonic() - start
        with TcpBoard(port=server.port, read_only=True, timeout=1.0) as watcher:
            return took, str(watcher.report.fault.name).lower()


def _drive(board: TcpBoard, valves: BenchValves) -> None:
    board.arm()
    while valves.pressure[0] < 49e3:
        try:
            board.write_pressure(np.full(2, 50e3))
        except BoardFault:
            board.arm()
        time.sleep(0.005)


def _keep(board: TcpBoard) -> None:
    """Go on until the connection or the board is lost."""
    with contextlib.suppress(ConnectionError, BoardFault, OSError):
        while True:
            board.write_pressure(np.full(2, 50e3))
            time.sleep(0.005)


def _said(board: TcpBoard) -> str:
    """What a client hears of a server that is gone."""
    try:
        board.read_pressure()
    except (OSError, BoardFault) as told:
        return str(told)
    raise AssertionError("the server still answers")


def _wait(condition) -> None:
    start = time.monotonic()
    while not condition():
        if time.monotonic() - start > 30:
            raise TimeoutError("the board did not get there")
        time.sleep(0.001)
