"""The one loop that runs a controller on a board."""

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from sorojax_hardware.protocols import Clock, Controller, ValveBoard


class Tick(NamedTuple):
    """One period of the loop."""

    time: float  # s since the loop started
    pressure: np.ndarray  # Pa, measured
    setpoint: np.ndarray  # Pa, written
    state: Any  # of the controller, after this tick
    late: float  # s between the planned and the real start


class Deadlines(NamedTuple):
    """How well a loop kept its period."""

    num_ticks: int
    num_skipped: int  # planned ticks that an earlier one overran
    median_late: float  # s
    max_late: float  # s


def run_loop(
    board: ValveBoard,
    clock: Clock,
    controller: Controller,
    state: Any,
    *,
    duration: float,
    period: float,
    limits: tuple[Any, Any],
    measure: Callable[[float, np.ndarray], Any] | None = None,
) -> Iterator[Tick]:
    """Run a pure controller on a board, one `Tick` per period.

    Every tick reads the pressures, measures, calls `controller(t, measurement, state)`,
    cuts the command to `limits` and writes it. Ticks that an overrun has missed are left
    out.
    The board is vented however the loop ends: run out, closed, or by an exception.

    Args:
        board: Where pressures are read and written.
        clock: What the loop waits for.
        controller: Returns `(command, state)`, one command [Pa] per port.
        state: The controller's state before the first tick.
        duration: Of the run [s].
        period: Between ticks [s].
        limits: Lowest and highest set-point, numbers or one per port [Pa].
        measure: What the controller sees, from time [s] and pressures [Pa], for instance
            an angle from a camera; the pressures if omitted.

    Raises:
        ValueError: If a time or a limit makes no sense, or a command is not finite.
    """
    if not (period > 0 and duration > 0):
        raise ValueError(
            f"run_loop: `period` is {period} s and `duration` {duration} s, need both "
            "positive. A loop at 100 Hz has period=0.01."
        )
    low, high = (np.broadcast_to(np.asarray(x, float), board.num_ports) for x in limits)
    if not np.all(low <= high):
        raise ValueError(
            f"run_loop: `limits` are {low} and {high} Pa, need (lowest, highest) gauge "
            "pressures. Swap them, and check for NaN."
        )
    see = measure or (lambda t, pressure: pressure)
    return _ticks(board, clock, see, controller, state, duration, period, low, high)


def _ticks(board, clock, see, controller, state, duration, period, low, high):
    start, tick = clock.now(), 0
    try:
        while tick < duration / period - 1e-9:
            # A NumPy number: compilers that treat Python's as constants compile once.
            t = np.float64(clock.now() - start)
            pressure = board.read_pressure()
            command, state = controller(t, see(t, pressure), state)
            setpoint = np.clip(_checked(command, board.num_ports, t), low, high)
            board.write_pressure(setpoint)
            yield Tick(t, pressure, setpoint, state, t - tick * period)
            tick = max(tick + 1, math.ceil((clock.now() - start) / period - 1e-9))
            clock.sleep_until(start + tick * period)
    finally:
        board.write_pressure(np.zeros(board.num_ports))


def _checked(command: Any, num_ports: int, t: float) -> np.ndarray:
    values = np.asarray(command, float)
    if values.ndim == 0:
        values = np.full(num_ports, values)
    if values.shape != (num_ports,) or not np.all(np.isfinite(values)):
        raise ValueError(
            f"run_loop: the controller commanded {values} Pa at t = {t:g} s, need "
            f"{num_ports} finite pressures, one per port. The board is vented."
        )
    return values


def deadlines(ticks: Iterable[Tick], period: float) -> Deadlines:
    """Statistics of the ticks of one run at `period` [s]."""
    seen = list(ticks)
    late = np.array([tick.late for tick in seen] or [0.0])
    planned = round((seen[-1].time - seen[-1].late) / period) + 1 if seen else 0
    return Deadlines(len(seen), planned - len(seen), float(np.median(late)), float(late.max()))
