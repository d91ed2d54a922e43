"""The safety state machine of the board: limits, slew, watchdog, trips, ramp to zero.

Everything that protects hardware and people is here, on the board's side of the wire, and
knows no socket: time comes in as an argument, so tests need not wait.
"""

import math
from collections.abc import Sequence
from typing import Protocol

from sorojax_board import config
from sorojax_board.config import Settings as Settings, settings as settings
from sorojax_board.messages import Fault, Flag, Refusal, Report, State

_BURST = 20.0  # set-points that may come at once


class Backend(Protocol):
    """Regulators and sensors."""

    def write(self, pressures: Sequence[float]) -> None:
        """Set-points [Pa, gauge] of every port."""

    def read(self, now: float) -> Sequence[float]:
        """Measured pressures [Pa, gauge] of every port."""
        ...


class Board:
    """Pressures follow set-points of the one owner while it keeps sending them.

    Raises:
        ValueError: If a number of the settings is not in its range.
    """

    def __init__(self, settings: Settings, backend: Backend, now: float = 0.0):
        config.check("Board", settings)
        count = len(settings.limits)
        self.settings, self.backend = settings, backend
        self.state, self.fault = State.VENTED, Fault(0)
        self.owner: object = None
        self.refused = 0
        self._ranges = [(limits.low, limits.high) for limits in settings.limits]
        self._target, self._setpoint = [0.0] * count, [0.0] * count
        self._ramp_from, self._ramp_start = [0.0] * count, now
        self._pressure, self._flags = [0.0] * count, [Flag(0)] * count
        self._off_track = [now] * count
        self._last, self._followed = now, (0, 0)
        self._fed, self._credit, self._credited = now, 1.0, now

    @property
    def num_ports(self) -> int:
        return len(self._setpoint)

    def arm(self, owner: object, ranges: Sequence[tuple[float, float]], now: float) -> None:
        """Follow `owner` from now on, within the narrower of its ranges and the board's.

        Raises:
            ValueError: If a range leaves nothing.
        """
        narrowed = []
        for (low, high), own in zip(ranges, self.settings.limits, strict=True):
            # comparisons with NaN are false, so it cannot pass
            if not max(low, own.low) <= min(high, own.high):
                raise ValueError(f"range {low} .. {high} Pa, need part of {own[:2]}")
            narrowed.append((max(low, own.low), min(high, own.high)))
        self._ranges = narrowed
        self.owner, self.state, self.fault = owner, State.ARMED, Fault(0)
        self._target, self._fed, self._credit = [0.0] * self.num_ports, now, _BURST
        self._off_track = [now] * self.num_ports
        self._flags = [Flag(0)] * self.num_ports

    def set(
        self, owner: object, mask: int, values: Sequence[float], stamp: tuple[int, int], now
    ) -> Refusal | None:
        """Take set-points [Pa], cut to the limits; the reason if they are refused.

        Args:
            owner: Who asks.
            mask: Bits of the ports that are meant.
            values: One pressure for every port.
            stamp: Sequence and time of the frame, for the report.
            now: Time [s].
        """
        why = self._refusal(owner, values, now)
        if why is not None:
            self.refused += 1
            return why
        for port, value in enumerate(values):
            if mask >> port & 1:
                low, high = self._ranges[port]
                kept = min(max(value, low), high)
                self._target[port] = kept
                self._flags[port] = Flag(0) if kept == value else Flag.CLIPPED
        self._fed, self._followed = now, stamp
        return None

    def _refusal(self, owner, values, now) -> Refusal | None:
        if self.state is not State.ARMED:
            return Refusal.NOT_ARMED
        if owner is not self.owner:
            return Refusal.NOT_WRITER
        if not all(map(math.isfinite, values)):
            return Refusal.NOT_FINITE
        gained = (now - self._credited) * self.settings.rate
        self._credit = min(self._credit + gained, _BURST)
        self._credited = now
        if self._credit < 1:
            self._fed = now  # somebody is there, only too eager
            return Refusal.TOO_FAST
        self._credit -= 1
        return None

    def vent(self, now: float) -> None:
        """Ramp to zero and follow nobody."""
        if self.state is State.ARMED:
            self._release(State.VENTED, Fault(0), now)

    def trip(self, fault: Fault, now: float) -> None:
        """Ramp to zero and stay there until armed again; the first reason counts."""
        if self.state is State.ARMED:
            self._release(State.FAULT, fault, now)

    def lost(self, owner: object, now: float) -> None:
        """The connection of `owner` is gone."""
        if owner is self.owner:
            self.trip(Fault.DISCONNECTED, now)
            self.owner = None

    def _release(self, state: State, fault: Fault, now: float) -> None:
        self.state, self.fault = state, fault
        self._ramp_from, self._ramp_start = list(self._setpoint), now

    def tick(self, now: float) -> None:
        """Advance set-points to `now`, drive the regulators, read and judge the sensors."""
        step, self._last = max(now - self._last, 0.0), now
        if self.state is State.ARMED and now - self._fed > self.settings.watchdog:
            self.trip(Fault.WATCHDOG, now)
        self._advance(step, now)
        try:
            self.backend.write(self._setpoint)
            self._pressure = [float(p) for p in self.backend.read(now)]
        except OSError:
            self.trip(Fault.BACKEND, now)
            return
        self._judge(now)

    def _advance(self, step: float, now: float) -> None:
        if self.state is not State.ARMED:
            left = max(0.0, 1 - (now - self._ramp_start) / self.settings.ramp)
            self._setpoint = [left * start for start in self._ramp_from]
            return
        for port, limits in enumerate(self.settings.limits):
            change = self._target[port] - self._setpoint[port]
            most = limits.slew * step
            slewing = abs(change) > most
            self._setpoint[port] += math.copysign(most, change) if slewing else change
            clipped = self._flags[port] & Flag.CLIPPED
            self._flags[port] = clipped | (Flag.SLEWING if slewing else Flag(0))

    def _judge(self, now: float) -> None:
        low, high = self.settings.plausible
        for port, pressure in enumerate(self._pressure):
            limits = self.settings.limits[port]
            if not low <= pressure <= high:
                self.trip(Fault.SENSOR, now)
            elif pressure > limits.high + self.settings.over_pressure or (
                pressure < limits.low - self.settings.over_pressure
            ):
                self.trip(Fault.OVER_PRESSURE, now)
            if abs(pressure - self._setpoint[port]) <= self.settings.tracking:
                self._off_track[port] = now
            elif now - self._off_track[port] > self.settings.patience:
                self.trip(Fault.TRACKING, now)

    def report(self) -> Report:
        return Report(
            *self._followed,
            self.state,
            self.fault,
            self.refused,
            tuple(self._pressure),
            tuple(self._setpoint),
            tuple(self._flags),
        )
