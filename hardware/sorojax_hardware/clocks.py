"""A clock that passes and a clock that is told."""

from time import perf_counter, sleep


class WallClock:
    """The machine's monotonic clock."""

    # Operating systems wake a sleeper late by up to about a millisecond.
    _spin = 1e-3

    def now(self) -> float:
        return perf_counter()

    def sleep_until(self, time: float) -> None:
        """Sleep, then watch the clock for the last millisecond."""
        if (left := time - self.now() - self._spin) > 0:
            sleep(left)
        while self.now() < time:
            pass


class SimulatedClock:
    """Time that passes only when somebody waits: loops run as fast as they compute."""

    def __init__(self, start: float = 0.0):
        self._now = float(start)

    def now(self) -> float:
        return self._now

    def sleep_until(self, time: float) -> None:
        self._now = max(self._now, float(time))
