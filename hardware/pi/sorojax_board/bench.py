"""Valves in memory, for the bench without hardware: lag, dead time, noise, steps of the DAC.

The numbers are of the size of a proportional regulator with a short hose; they are not
measured on one. A fault can be put in to see what the board makes of it.
"""

import math
import random
from collections import deque
from collections.abc import Callable, Sequence

STEP = 200e3 / 4095  # Pa, 12 bits over -100 .. 100 kPa


class BenchValves:
    """Second-order valves behind 12-bit converters.

    Args:
        ports: Number of ports.
        frequency: Bandwidth of the closed valve loop [Hz].
        damping: Its damping ratio.
        dead_time: Before a valve reacts [s].
        noise: Of the sensors, standard deviation [Pa].
        leak: Rate at which a chamber returns to ambient [1/s].
        seed: Of the noise.
    """

    def __init__(
        self,
        ports: int = 12,
        *,
        frequency: float = 12.0,
        damping: float = 0.9,
        dead_time: float = 0.004,
        noise: float = 80.0,
        leak: float = 0.0,
        seed: int = 0,
    ):
        self._omega, self._damping = 2 * math.pi * frequency, damping
        self._dead_time, self._noise, self._leak = dead_time, noise, leak
        self._random = random.Random(seed)
        self._pressure, self._rate = [0.0] * ports, [0.0] * ports
        self._waiting: deque[tuple[float, tuple[float, ...]]] = deque()
        self._written = self._asked = (0.0,) * ports
        self._now: float | None = None
        self.stuck: set[int] = set()  # ports whose valve does not move
        self.reading: Callable[[int, float], float] | None = None  # a false sensor

    @property
    def pressure(self) -> list[float]:
        """True pressures [Pa]."""
        return list(self._pressure)

    def write(self, pressures: Sequence[float]) -> None:
        self._written = tuple(round(p / STEP) * STEP for p in pressures)

    def read(self, now: float) -> list[float]:
        self._advance(now)
        return [self._sensor(port, p) for port, p in enumerate(self._pressure)]

    def _sensor(self, port: int, pressure: float) -> float:
        told = pressure + self._random.gauss(0.0, self._noise)
        told = round(told / STEP) * STEP
        return told if self.reading is None else self.reading(port, told)

    def _advance(self, now: float) -> None:
        start = now if self._now is None else self._now
        self._now = now
        self._waiting.append((start + self._dead_time, self._written))
        steps = min(math.ceil((now - start) / 5e-4), 2000)
        for k in range(steps):
            h = (now - start) / steps
            while self._waiting and self._waiting[0][0] <= start + (k + 0.5) * h:
                self._asked = self._waiting.popleft()[1]
            for port, asked in enumerate(self._asked):
                self._step(port, asked, h)

    def _step(self, port: int, asked: float, h: float) -> None:
        if port in self.stuck:
            return
        pull = self._omega**2 * (asked - self._pressure[port])
        self._rate[port] += h * (pull - 2 * self._damping * self._omega * self._rate[port])
        self._pressure[port] += h * (self._rate[port] - self._leak * self._pressure[port])
