"""Boards that this process runs itself, so that programs for a bench run without one."""

import asyncio
import contextlib
import math
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from sorojax_board.bench import STEP
from sorojax_board.board import Backend, Board, Settings
from sorojax_board.server import Server

_MOST_BEHIND = 0.01  # s that one reading makes up for; the program has to go on meanwhile


class ModelValves:
    """A simulated robot behind the board: `advance(state, setpoint, dt)` moves it.

    A model that takes longer than the time that passes goes on in slow motion; `behind` [s]
    is how much it has left out.

    Args:
        advance: `(state, setpoints [Pa], dt [s]) -> (state, pressures [Pa])`, for instance
            a compiled step of a network of reservoirs and a body.
        state: Where it starts.
        num_ports: Of the board.
        period: Step of the model [s]; several are made when more time has passed.
        dead_time: Before a set-point reaches the model [s].
        noise: Of the sensors, standard deviation [Pa].
        resolution: Step of the converters on both sides [Pa]; 0 for exact ones.
        seed: Of the noise.
        keep: Keep the state after every step in `states`, behind the first one.
    """

    def __init__(
        self,
        advance: Callable[[Any, np.ndarray, float], tuple[Any, Any]],
        state: Any,
        num_ports: int,
        *,
        period: float = 0.005,
        dead_time: float = 0.0,
        noise: float = 80.0,
        resolution: float = STEP,
        seed: int = 0,
        keep: bool = False,
    ):
        self._advance, self.state, self._period = advance, state, period
        self.states = [state] if keep else None
        self._random, self._noise = np.random.default_rng(seed), noise
        self._dead_time, self._resolution = dead_time, resolution
        self._setpoint = self._asked = np.zeros(num_ports)
        self._waiting: deque[tuple[float, np.ndarray]] = deque()
        self.pressure, self._now, self.behind = np.zeros(num_ports), math.nan, 0.0

    def write(self, pressures: Sequence[float]) -> None:
        self._asked = self._rounded(np.asarray(pressures, float))

    def read(self, now: float) -> list[float]:
        if math.isnan(self._now):
            self._now = now
        late = max(now - self._now - max(_MOST_BEHIND, 2 * self._period), 0.0)
        self._now, self.behind = self._now + late, self.behind + late
        self._waiting.append((now + self._dead_time, self._asked))
        while now - self._now >= self._period - 1e-9:
            self._now += self._period
            while self._waiting and self._waiting[0][0] <= self._now:
                self._setpoint = self._waiting.popleft()[1]
            self.state, pressure = self._advance(self.state, self._setpoint, self._period)
            self.pressure = np.asarray(pressure, float)
            if self.states is not None:
                self.states.append(self.state)
        noisy = self.pressure + self._noise * self._random.standard_normal(self.pressure.shape)
        return self._rounded(noisy).tolist()

    def _rounded(self, pressure: np.ndarray) -> np.ndarray:
        if self._resolution == 0:
            return pressure
        return np.rint(pressure / self._resolution) * self._resolution


@contextlib.contextmanager
def serve(settings: Settings, backend: Backend, **options) -> Iterator[Server]:
    """A board on this machine in a thread, as `with serve(settings(2), BenchValves(2)) as s`.

    Connect with `TcpBoard(port=s.port)`. `options` are those of `sorojax_board.server.Server`;
    the port is a free one unless given.

    Args:
        settings: Limits of the board.
        backend: The valves.
        **options: Of `sorojax_board.server.Server`.

    Returns:
        A context manager of the server.
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
