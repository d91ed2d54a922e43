"""The one loop that runs a controller on a board."""

import gc
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sorojax_hardware.protocols import Clock, Controller, ValveBoard
from sorojax_hardware.recorder import Recorder


class Tick(NamedTuple):
    """One period of the loop.

    Attributes:
        time: Since the loop started [s].
        pressure: Measured, one per port [Pa].
        setpoint: Written, one per port [Pa].
        state: Of the controller, after this tick.
        late: From the planned to the real start [s].
    """

    time: float
    pressure: np.ndarray
    setpoint: np.ndarray
    state: Any
    late: float


class Deadlines(NamedTuple):
    """How well a loop kept its period.

    Attributes:
        num_ticks: Ticks that ran.
        num_skipped: Planned ones that were left out after an overrun.
        num_behind: Ticks that began more than a period late.
        median_late, p99_late, max_late: Median, 99th percentile and maximum of delays [s].
    """

    num_ticks: int
    num_skipped: int
    num_behind: int
    median_late: float
    p99_late: float
    max_late: float


class Overrun(RuntimeError):
    """A tick took longer than the loop allows; the board is vented."""


def run_loop(
    board: ValveBoard,
    clock: Clock,
    controller: Controller,
    state: Any,
    *,
    duration: float,
    period: float,
    limits: tuple[Any, Any],
    slew: Any = np.inf,
    measure: Callable[[float, np.ndarray], Any] | None = None,
    catch_up: int = 4,
    max_skipped: float = np.inf,
    record: Recorder | None = None,
) -> Iterator[Tick]:
    """Run a pure controller on a board, one `Tick` per period.

    Every tick reads the pressures, measures, calls `controller(t, measurement, state)`,
    cuts the command to `limits` and `slew` and writes it. After an overrun the missed ticks
    run at once, so that a controller in discrete time and the record have every sample; if
    the loop is further behind than `catch_up` ticks, those are left out. The board is vented
    however the loop ends: run out, closed, or by an exception.

    Args:
        board: Where pressures are read and written.
        clock: What the loop waits for.
        controller: Returns `(command, state)`, one command [Pa] per port.
        state: The controller's state before the first tick.
        duration: Of the run [s].
        period: Between ticks [s].
        limits: Lowest and highest set-point, numbers or one per port [Pa].
        slew: Fastest change of a set-point, a number or one per port [Pa/s].
        measure: What the controller sees, from time [s] and pressures [Pa], for instance
            an angle from a camera; the pressures if omitted.
        catch_up: Missed ticks that are made up for; 0 leaves out every one.
        max_skipped: Ticks that the loop may be behind before it gives up.
        record: Takes every tick; make it with `tick_recorder`.

    Returns:
        The ticks, one after the other, as they happen.

    Raises:
        ValueError: If a time or a limit makes no sense, or a command is not finite.
        Overrun: If a tick overran more than `max_skipped` others.
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
    most = np.broadcast_to(np.asarray(slew, float), board.num_ports)
    if not np.all(most > 0):
        raise ValueError(f"run_loop: `slew` is {slew} Pa/s, need it positive. 1e6 is quick.")
    see = measure or (lambda t, pressure: pressure)
    bounds = _Bounds(low, high, most)
    pace = _Pace(period, math.ceil(duration / period - 1e-9), catch_up, max_skipped)
    return _ticks(board, clock, see, controller, state, pace, bounds, record)


class _Bounds(NamedTuple):
    low: np.ndarray
    high: np.ndarray
    slew: np.ndarray

    def cut(self, wanted: np.ndarray, before: np.ndarray, step: float) -> np.ndarray:
        change = self.slew * max(step, 1e-9)  # made-up ticks may fall into one instant
        return np.clip(np.clip(wanted, before - change, before + change), self.low, self.high)


class _Pace(NamedTuple):
    period: float  # s
    num_ticks: int
    catch_up: int
    max_skipped: float

    def after(self, tick: int, elapsed: float) -> int:
        """The tick that follows `tick`, which ended at `elapsed` [s]."""
        missed = math.ceil(elapsed / self.period - 1e-9) - tick - 1
        if missed > self.max_skipped:
            raise Overrun(
                f"run_loop: the tick at {tick * self.period:g} s overran {missed} others, "
                f"`max_skipped` is {self.max_skipped:g}. Make the controller faster or the "
                "period longer. The board is vented."
            )
        return tick + 1 if missed <= self.catch_up else tick + 1 + missed


def _ticks(board, clock, see, controller, state, pace: _Pace, bounds, record):
    # What there is now is not looked through for garbage again: that takes many ticks.
    freezes = gc.get_freeze_count() == 0
    if freezes:
        gc.freeze()
    start, tick = clock.now(), 0
    setpoint, before = np.clip(np.zeros(board.num_ports), bounds.low, bounds.high), -pace.period
    try:
        while tick < pace.num_ticks:
            # A NumPy number: compilers that treat Python's as constants compile once.
            t = np.float64(clock.now() - start)
            late = t - tick * pace.period
            pressure = board.read_pressure()
            command, state = controller(t, see(t, pressure), state)
            wanted = _checked(command, board.num_ports, t)
            setpoint, before = bounds.cut(wanted, setpoint, t - before), t
            board.write_pressure(setpoint)
            if record is not None:
                record.write(t, late, pressure, setpoint)
            yield Tick(t, pressure, setpoint, state, late)
            tick = pace.after(tick, clock.now() - start)
            clock.sleep_until(start + tick * pace.period)
    finally:
        board.vent()
        if freezes:
            gc.unfreeze()


def tick_recorder(path: str | Path, num_ports: int, **about) -> Recorder:
    """A file for the ticks of one run; `load_record` gives time, late, pressure, setpoint.

    Args:
        path: File name.
        num_ports: Ports of the board.
        **about: What is told about the run.

    Returns:
        The recorder, for `run_loop`.
    """
    columns = ["time", "late"]
    for name in ("pressure", "setpoint"):
        columns += [f"{name}[{port}]" for port in range(num_ports)]
    return Recorder(path, columns, **about)


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
    """Statistics of the ticks of one run at `period` [s].

    Args:
        ticks: Of the run.
        period: Between them [s].

    Returns:
        How late ticks were, and how many were missed.
    """
    seen = list(ticks)
    late = np.array([tick.late for tick in seen] or [0.0])
    planned = round((seen[-1].time - seen[-1].late) / period) + 1 if seen else 0
    median, p99 = np.percentile(late, (50, 99))
    skipped, behind = planned - len(seen), int(np.sum(late > period))
    return Deadlines(len(seen), skipped, behind, float(median), float(p99), float(late.max()))
