"""A board's program without a socket."""

import numpy as np

from sorojax_board.board import Backend, Board, Settings
from sorojax_hardware.protocols import Clock


class LocalBoard:
    """A board's program without a socket, on any clock: a `ValveBoard`.

    With a `SimulatedClock` a run is as fast as its computations and the same every time.
    """

    _period = 0.002  # s, between ticks of the program

    def __init__(self, settings: Settings, backend: Backend, clock: Clock):
        self._clock, self._ticked, self._count = clock, clock.now(), 0
        self.board = Board(settings, backend, self._ticked)

    @property
    def num_ports(self) -> int:
        return self.board.num_ports

    def arm(self, limits=(-1e9, 1e9)) -> None:
        """As `TcpBoard.arm`."""
        low, high = (np.broadcast_to(np.asarray(x, float), self.num_ports) for x in limits)
        bounds = list(zip(low.tolist(), high.tolist(), strict=True))
        self.board.arm(self, bounds, self._clock.now())

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
        why = self.board.set(self, mask, asked.tolist(), stamp, self._clock.now())
        if why is not None:
            report = self.board.report()
            raise ValueError(
                f"LocalBoard: the board refused: {why.name}, state {report.state.name}, faults "
                f"{report.fault!r}. Call arm() after the cause is gone."
            )

    def vent(self) -> None:
        self._advance()
        self.board.vent(self._clock.now())

    def _advance(self) -> None:
        while self._ticked + self._period <= self._clock.now() + 1e-9:
            self._ticked += self._period
            self.board.tick(self._ticked)
