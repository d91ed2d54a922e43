"""The raw stream of the first Sorotoki control platform, for its existing clients.

One float64 per port and message, nothing else: commands u = (p + 100) / 200 with p in kPa,
answers the sensor voltages V with p = 20 (V - 5) kPa. It has no key, no order and no
arming: the first message of a connection arms, and after a fault only a new connection
does. A message that cannot be commands ends the connection, as what follows it cannot be
trusted. All else that protects is on the board's side.

Reference: Caasenbrood et al., "Sorotoki: A Matlab Toolkit for Design, Modeling, and
Control of Soft Robots", IEEE Access 12, 2024.
"""

import struct

from sorojax_board.board import Board
from sorojax_board.i2c import pressure_of_command, voltage_of_pressure
from sorojax_board.session import HANDSHAKE

_LEAST = 2.0**-30  # below it a command is a byte pattern, not a pressure: 0.2 mPa
_TEXT = frozenset(b"\t\r\n" + bytes(range(32, 127)))


class LegacySession:
    """One connection of the raw protocol, with the face of `session.Session`."""

    def __init__(self, board: Board, now: float):
        self.board, self.closed, self.ready, self.last_heard = board, "", False, now
        self._message = struct.Struct(f"<{board.num_ports}d")
        self._widest = [(one.low, one.high) for one in board.settings.limits]
        self._buffer, self._count, self._armed = b"", 0, False

    def challenge(self, now: float) -> bytes:
        return b""

    def tick(self, now: float) -> bytes:
        if not self.ready and not self.closed and now - self.last_heard > HANDSHAKE:
            self.close("no command in time", now)
        return b""

    def state(self, now: float) -> bytes:
        volts = [voltage_of_pressure(p) for p in self.board.report().pressure]
        return self._message.pack(*volts)

    def receive(self, data: bytes, now: float) -> bytes:
        view, size = self._buffer + data, self._message.size
        answers, at = [], 0
        while not self.closed and len(view) - at >= size:
            self._follow(view[at : at + size], now)
            answers.append(b"" if self.closed else self.state(now))
            at += size
        self._buffer = b"" if self.closed else view[at:]
        return b"".join(answers)

    def lost(self, now: float) -> None:
        self.close(self.closed or "connection lost", now)

    def close(self, why: str, now: float) -> None:
        self.closed = why
        self.board.lost(self, now)

    def _follow(self, message: bytes, now: float) -> None:
        command = self._message.unpack(message)
        if not _sane(message, command):
            self.board.refused += 1
            self.close("a message that is no commands in [0, 1], one for each port", now)
            return
        if not self._armed and self.board.owner is None:
            self._armed = True
            self.board.arm(self, self._widest, now)
        self.ready, self.last_heard = True, now
        self._count += 1
        values = [pressure_of_command(u) for u in command]
        self.board.set(self, (1 << len(values)) - 1, values, (self._count, 0), now)


def _sane(message: bytes, command: tuple[float, ...]) -> bool:
    """Whether these are commands. Bytes of another protocol may be tiny numbers, and eight
    characters may be one in [0, 0.008]: neither is what a client computes."""
    text = any(_TEXT.issuperset(message[at : at + 8]) for at in range(0, len(message), 8))
    return not text and all(u == 0 or _LEAST <= u <= 1 for u in command)
