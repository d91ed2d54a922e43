"""A board served from this process, so that programs for a bench run without one."""

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from sorojax_board.board import Backend, Board, Settings
from sorojax_board.server import Server

_MOST_BEHIND = 1.0  # s; after a longer pause the model goes on from where it was


class ModelValves:
    """A simulated robot behind the board: `advance(state, setpoint, dt)` moves it.

    Args:
        advance: `(state, setpoints [Pa], dt [s]) -> (state, pressures [Pa])`, for instance
            a compiled step of a network of reservoirs and a body.
        state: Where it starts.
        num_ports: Of the board.
        period: Step of the model [s]; several are made when more time has passed.
        noise: Of the sensors, standard deviation [Pa].
        seed: Of the noise.
    """

    def __init__(
        self,
        advance: Callable[[Any, np.ndarray, float], tuple[Any, Any]],
        state: Any,
        num_ports: int,
        *,
        period: float = 0.005,
        noise: float = 80.0,
        seed: int = 0,
    ):
        self._advance, self.state, self._period = advance, state, period
        self._random, self._noise = np.random.default_rng(seed), noise
        self._setpoint, self.pressure = np.zeros(num_ports), np.zeros(num_ports)
        self._now: float | None = None

    def write(self, pressures: Sequence[float]) -> None:
        self._setpoint = np.asarray(pressures, float)

    def read(self, now: float) -> list[float]:
        if self._now is None or now - self._now > _MOST_BEHIND:
            self._now = now
        while now - self._now >= self._period:
            self.state, pressure = self._advance(self.state, self._setpoint, self._period)
            self.pressure = np.asarray(pressure, float)
            self._now += self._period
        noisy = self.pressure + self._noise * self._random.standard_normal(self.pressure.shape)
        return noisy.tolist()


@contextlib.contextmanager
def serve(settings: Settings, backend: Backend, **options) -> Iterator[Server]:
    """A board on this machine in a thread, as `with serve(settings(2), BenchValves(2)) as s`.

    Connect with `TcpBoard(port=s.port)`. `options` are those of `sorojax_board.server.Server`;
    the port is a free one unless given.
    """
    from time import monotonic

    ready, loop = threading.Event(), asyncio.new_event_loop()
    server = Server(Board(settings, backend, monotonic()), **{"port": 0, **options})
    task = loop.create_task(server.run(ready.set))
    failure: list[BaseException] = []

    def work() -> None:
        try:
            with contextlib.suppress(asyncio.CancelledError):
                loop.run_until_complete(task)
        except BaseException as reason:
            failure.append(reason)
            ready.set()

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    ready.wait(10)
    if failure:
        raise failure[0]
    try:
        yield server
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join(10)
        loop.close()
