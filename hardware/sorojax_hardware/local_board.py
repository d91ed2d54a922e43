"""A board's program without a socket."""

from collections.abc import Callable
from typing import Any

import numpy as np

from sorojax_board.board import Backend, Board, Settings
from sorojax_board.messages import Limits
from sorojax_hardware.clocks import SimulatedClock
from sorojax_hardware.protocols import Clock
from sorojax_hardware.serving import ModelValves


class LocalBoard:
    """A board's program without a socket, on any clock: a `ValveBoard`.

    With a `SimulatedClock` a run is as fast as its computations and the same every time.
    """

    _period = 0.002  # s, between ticks of the program

    def __init__(self, settings: Settings, backend: Backend, clock: Clock):
        self.clock, self._ticked, self._count = clock, clock.now(), 0
        self.board = Board(settings, backend, self._ticked)

    @property
    def num_ports(self) -> int:
        return self.board.num_ports

    def arm(self, limits=(-1e9, 1e9)) -> None:
        """As `TcpBoard.arm`."""
        low, high = (np.broadcast_to(np.asarray(x, float), self.num_ports) for x in limits)
        bounds = list(zip(low.tolist(), high.tolist(), strict=True))
        self.board.arm(self, bounds, self.clock.now())

    def read_pressure(self) -> np.ndarray:
        self._advance()
        return np.array(self.board.report().pressure)

    def write_pressure(self, setpoint: np.ndarray) -> None:
        """As `TcpBoard.write_pressure`.

        Raises:
            ValueError: If the set-points are not finite, not one per port, or the board does
                not follow.
        """
        asked = np.asarray(setpoint, float)
        if asked.shape != (self.num_ports,):
            raise ValueError(
                f"LocalBoard: `setpoint` has shape {asked.shape}, need ({self.num_ports},)."
            )
        self._advance()
        self._count += 1
        mask, stamp = (1 << self.num_ports) - 1, (self._count, 0)
        why = self.board.set(self, mask, asked.tolist(), stamp, self.clock.now())
        if why is not None:
            report = self.board.report()
            raise ValueError(
                f"LocalBoard: the board refused: {why.name}, state {report.state.name}, faults "
                f"{report.fault!r}. Call arm() after the cause is gone."
            )

    def vent(self) -> None:
        self._advance()
        self.board.vent(self.clock.now())

    def _advance(self) -> None:
        while self._ticked + self._period <= self.clock.now() + 1e-9:
            self._ticked += self._period
            self.board.tick(self._ticked)


def simulated_board(
    advance: Callable[[Any, np.ndarray, float], tuple[Any, Any]],
    state: Any,
    limits: tuple[Any, Any],
    *,
    slew: float = 2e6,
    clock: Clock | None = None,
    **options: Any,
) -> tuple[LocalBoard, ModelValves]:
    """A simulated robot behind an armed board of this process, and its valves, whose `state`
    is the robot's.

    Args:
        advance: `(state, setpoints [Pa], dt [s]) -> (state, pressures [Pa])`.
        state: Where it starts.
        limits: Lowest and highest set-points [Pa], one or several of each.
        slew: Fastest change of a set-point [Pa/s].
        clock: `board.clock`; a `SimulatedClock` if omitted.
        **options: Of `ModelValves`.

    Returns:
        The board, armed, and its valves.
    """
    low, high = np.broadcast_arrays(*(np.atleast_1d(np.asarray(x, float)) for x in limits))
    each = tuple(Limits(float(a), float(b), slew) for a, b in zip(low, high, strict=True))
    valves = ModelValves(advance, state, len(each), **options)
    board = LocalBoard(Settings(each), valves, SimulatedClock() if clock is None else clock)
    board.arm()
    return board, valves
