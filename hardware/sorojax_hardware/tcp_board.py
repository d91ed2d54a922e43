"""A valve board on the network."""

import contextlib
import time
from collections.abc import Iterator

import numpy as np

from sorojax_board import messages
from sorojax_board.frames import Kind
from sorojax_board.messages import Refusal, Report, State
from sorojax_hardware.board_fault import BoardFault, explained
from sorojax_hardware.link import Link

_TRIES = 5


class TcpBoard:
    """The client of `sorojax_board`, a `ValveBoard`.

    Every call is answered within the time-out or raises; a set-point is never sent twice.
    The board vents by itself when the set-points stop. `late` counts set-points that it left
    out because they were under way too long, or came too fast. Use it in a `with` statement:

        with TcpBoard("10.0.0.7", key=key) as board: ...
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 5053, *, key: bytes = b"", **link):
        """
        Args:
            host: Address of the board.
            port: Of its framed protocol.
            key: The key that it shares with this machine.
            **link: `read_only=True` to watch only (the board has one writer), and
                `timeout`, the longest wait for an answer [s], 0.2 unless given.

        Raises:
            ConnectionError: If there is no board, or it has another key or protocol.
        """
        self._link, self.late = Link(host, port, key, **link), 0
        self.report = self._ask(Kind.PING)

    @property
    def num_ports(self) -> int:
        return len(self._link.welcome.limits)

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest set-point that the board follows [Pa]."""
        low, high, _ = np.array(self._link.welcome.limits).T
        return low, high

    def arm(self, limits=(-1e9, 1e9)) -> None:
        """Let the board follow; `limits` [Pa], numbers or one per port, narrow its own.

        Raises:
            BoardFault: If another client writes, or the limits leave nothing.
        """
        low, high = (np.broadcast_to(np.asarray(x, float), self.num_ports) for x in limits)
        bounds = [(float(a), float(b)) for a, b in zip(low, high, strict=True)]
        self.report = self._ask(Kind.ARM, messages.pack_arm(bounds))

    def read_pressure(self) -> np.ndarray:
        self.report = self._ask(Kind.PING)
        return np.array(self.report.pressure)

    def write_pressure(self, setpoint: np.ndarray) -> None:
        """Ask for gauge pressures [Pa], cut to the board's limits.

        Raises:
            ValueError: If they are not finite or not one per port.
            BoardFault: If the board does not follow; it says why.
            ConnectionError: If no answer came in time.
        """
        asked = np.asarray(setpoint, float)
        if asked.shape != (self.num_ports,) or not np.all(np.isfinite(asked)):
            raise ValueError(
                f"TcpBoard: `setpoint` is {asked} Pa, need {self.num_ports} finite gauge "
                "pressures, one per port. The board keeps its last ones until its watchdog."
            )
        bound = np.clip(asked, *self.limits).tolist()
        mask = (1 << self.num_ports) - 1
        self.report = self._ask(Kind.SET, messages.pack_set(mask, bound))

    def vent(self) -> None:
        """Ramp to zero; the board follows again after `arm`."""
        self.report = self._ask(Kind.VENT)

    def watch(self, period: float = 0.1) -> Iterator[Report]:
        """The heartbeat of the board: what it measures, every `period` [s] by itself.

        Raises:
            ConnectionError: If a heartbeat does not come in time.
            BoardFault: If `period` is not between 2 ms and 10 s.
        """
        self.report = self._ask(Kind.WATCH, messages.pack_floats([period]))
        try:
            while True:
                self.report = messages.unpack_report(self._link.listen(period).payload)
                yield self.report
        finally:
            with contextlib.suppress(OSError):  # of a board that is gone
                self._ask(Kind.WATCH, messages.pack_floats([0.0]))

    def close(self) -> None:
        """Say goodbye: the board vents."""
        self._link.close()

    def __enter__(self) -> "TcpBoard":
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def _ask(self, kind: Kind, payload: bytes = b"") -> Report:
        frame = self._link.ask(kind, payload)
        if frame.kind == Kind.STATE:
            return messages.unpack_report(frame.payload)
        _, why = messages.unpack_refused(frame.payload)
        report = self._now()
        if kind is Kind.PING:
            return report
        if why in (Refusal.STALE, Refusal.TOO_FAST) and report.state is State.ARMED:
            self.late += 1  # the next set-point may be in time; if none is, the board vents
            return report
        raise BoardFault(explained(kind, why, report), report)

    def _now(self) -> Report:
        for _ in range(_TRIES):  # on a busy line a question may be stale too
            frame = self._link.ask(Kind.PING)
            if frame.kind == Kind.STATE:
                return messages.unpack_report(frame.payload)
        self._link.close()
        raise ConnectionError(
            f"TcpBoard: {_TRIES} frames in a row were 0.1 s late. Make a new TcpBoard."
        )


def connect(host: str = "127.0.0.1", port: int = 5053, *, attempts: int = 6, **options):
    """A `TcpBoard`, tried again with growing pauses (0.1 s, 0.2 s, ...) while there is none.

    Args:
        host: Name or address of the board.
        port: Where it listens.
        attempts: Number of tries.
        **options: Of `TcpBoard`.

    Returns:
        The board, connected.

    Raises:
        ConnectionError: If the last attempt fails too.
    """
    for attempt in range(attempts - 1):
        try:
            return TcpBoard(host, port, **options)
        except ConnectionError:
            time.sleep(0.1 * 2**attempt)
    return TcpBoard(host, port, **options)
