"""What the network does to a board in the middle of a run, and what the board says of it."""

import time

import numpy as np
import pytest

from sorojax_board.bench import BenchValves
from sorojax_board.board import settings
from sorojax_board.messages import Fault, State
from sorojax_hardware import BoardFault, DisturbedLink, TcpBoard, serve

kPa = 1e3
FAULTS = {
    "cut": (lambda link: link.cut(), {Fault.DISCONNECTED}),
    "frozen": (lambda link: link.freeze(), {Fault.WATCHDOG}),
    "delayed": (lambda link: setattr(link, "delay", 0.4), {Fault.WATCHDOG}),
}


def drive(board, link, seconds, until=np.inf):
    """Set-points every 5 ms, for a time or until the board is at a pressure."""
    start, pressure = time.monotonic(), 0.0
    while time.monotonic() - start < seconds and pressure < until:
        try:
            board.write_pressure(np.full(2, 50 * kPa))
        except BoardFault:  # the watchdog of a board on a busy machine
            board.arm()
        pressure = board.report.pressure[0]
        time.sleep(0.005)
    return pressure


@pytest.mark.parametrize("kind", FAULTS)
def test_a_network_that_fails_leaves_the_board_at_zero_with_the_reason(kind):
    fail, reasons = FAULTS[kind]
    valves = BenchValves(2, noise=0.0)
    with (
        serve(settings(2, low=-10 * kPa, high=60 * kPa), valves) as server,
        DisturbedLink(server.port) as link,
    ):
        board = TcpBoard(port=link.port, timeout=5.0)
        board.arm()
        assert drive(board, link, 10.0, 49 * kPa) > 49 * kPa
        board._link._timeout = 0.2
        fail(link)
        start = time.monotonic()
        with pytest.raises((ConnectionError, BoardFault)):
            drive(board, link, 5.0)
        while max(map(abs, valves.pressure)) > 0.5 * kPa:
            assert time.monotonic() - start < 5.0
            time.sleep(0.005)
        # 0.55 s on a quiet machine (benchmark hardware.network); exact in tests/test_board.py
        assert time.monotonic() - start < 1.5
        with TcpBoard(port=server.port, read_only=True, timeout=5.0) as watcher:
            assert watcher.report.state is State.FAULT
            # a busy machine may have let the watchdog speak first
            assert watcher.report.fault in reasons | {Fault.WATCHDOG}


def test_a_slow_network_is_borne():
    with (
        serve(settings(2, watchdog=5.0), BenchValves(2, noise=0.0)) as server,
        DisturbedLink(server.port) as link,
    ):
        link.delay = 0.02
        with TcpBoard(port=link.port, timeout=5.0) as board:
            board.arm()
            assert drive(board, link, 10.0, 49 * kPa) > 49 * kPa
            assert board.report.state is State.ARMED and board.late == 0
