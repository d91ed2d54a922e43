"""The raw stream of the first Sorotoki control platform, for its existing clients.

One float64 per port and message, nothing else: commands u = (p + 100) / 200 with p in kPa,
answers the sensor voltages V with p = 20 (V - 5) kPa. It has no key, no order and no
arming: the first message of a connection arms, and after a fault only a new connection
does. All that protects is on the board's side.

Reference: Caasenbrood et al., "Sorotoki: A Matlab Toolkit for Design, Modeling, and
Control of Soft Robots", IEEE Access 12, 2024.
"""

import math
import struct

from sorojax_board.board import Board


def pressure_of_command(u: float) -> float:
    """Set-point [Pa] of a command in [0, 1]."""
    return (200 * u - 100) * 1e3


def voltage_of_pressure(pressure: float) -> float:
    """Sensor voltage [V] of a pressure [Pa]."""
    return pressure / 20e3 + 5


class LegacySession:
    """One connection of the raw protocol, with the face of `session.Session`."""

    def __init__(self, board: Board, now: float):
        self.board, self.closed = board, ""
        self._message = struct.Struct(f"<{board.num_ports}d")
        self._widest = [(one.low, one.high) for one in board.settings.limits]
        self._buffer, self._count, self._armed = b"", 0, False

    def challenge(self, now: float) -> bytes:
        return b""

    def tick(self, now: float) -> bytes:
        return b""

    def state(self, now: float) -> bytes:
        volts = [voltage_of_pressure(p) for p in self.board.report().pressure]
        return self._message.pack(*volts)

    def receive(self, data: bytes, now: float) -> bytes:
        if self.closed:
            return b""
        view = self._buffer + data
        whole = len(view) // self._message.size * self._message.size
        self._buffer = view[whole:]
        answers = []
        for at in range(0, whole, self._message.size):
            command = self._message.unpack_from(view, at)
            self._follow(command, now)
            answers.append(self.state(now))
        return b"".join(answers)

    def lost(self, now: float) -> None:
        self.closed = self.closed or "connection lost"
        self.board.lost(self, now)

    def _follow(self, command: tuple[float, ...], now: float) -> None:
        sane = all(math.isfinite(u) and 0 <= u <= 1 for u in command)
        if not sane:  # most likely another protocol: a stream without frames cannot tell
            self.board.refused += 1
            return
        if not self._armed and self.board.owner is None:
            self._armed = True
            self.board.arm(self, self._widest, now)
        self._count += 1
        values = [pressure_of_command(u) for u in command]
        self.board.set(self, (1 << len(values)) - 1, values, (self._count, 0), now)
