"""The connection to a board: one question, one answer, within a time-out."""

import contextlib
import os
import socket
from collections.abc import Callable
from time import monotonic

from sorojax_board import messages
from sorojax_board.frames import (
    NONCE_SIZE,
    Decoder,
    Frame,
    Keys,
    Kind,
    authentic,
    challenge_key,
    encode,
    session_keys,
)
from sorojax_board.messages import Welcome
from sorojax_board.session import READER, WRITER


class Link:
    """Frames to and from the board at `host`; see hardware/PROTOCOL.md.

    Whatever goes wrong closes the connection: an answer that came later would be taken for
    that of the next question.
    """

    def __init__(
        self,
        host: str,
        port: int,
        key: bytes,
        *,
        read_only: bool = False,
        timeout: float = 0.2,
        random: Callable[[int], bytes] = os.urandom,
    ):
        self._timeout, self._decoder = timeout, Decoder()
        self._waiting: list[Frame] = []
        self._sent = self._heard = 0
        try:
            self._socket = socket.create_connection((host, port), timeout)
        except OSError as reason:
            raise ConnectionError(
                f"TcpBoard: no board at {host}:{port} ({reason}). Start it there with "
                "`python -m sorojax_board`, or check the address."
            ) from reason
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            self.welcome = self._handshake(key, read_only, random(NONCE_SIZE))
        except BaseException:
            self._socket.close()
            raise

    def ask(self, kind: Kind, payload: bytes = b"") -> Frame:
        """The board's answer, authentic and in order; heartbeats before it are passed over.

        Raises:
            ConnectionError: If none came in time, or one that is not the board's.
        """
        self._send(kind, payload)
        while (frame := self._trusted(self._timeout)).kind == Kind.HEARTBEAT:
            pass
        return frame

    def listen(self, period: float) -> Frame:
        """The next heartbeat of a board that sends one every `period` [s].

        Raises:
            ConnectionError: As `ask`.
        """
        return self._trusted(self._timeout + period)

    def _trusted(self, patience: float) -> Frame:
        frame = self._receive(patience)
        if not authentic(frame, self._keys.to_client) or frame.sequence <= self._heard:
            self._socket.close()
            raise ConnectionError("TcpBoard: an answer that is not the board's.")
        self._heard = frame.sequence
        return frame

    def close(self) -> None:
        with contextlib.suppress(OSError):  # a board that is gone notices by itself
            self._send(Kind.BYE, b"")
        self._socket.close()

    def _handshake(self, key: bytes, read_only: bool, nonce: bytes) -> Welcome:
        first = self._receive(self._timeout)
        if first.kind != Kind.CHALLENGE or not authentic(first, challenge_key(key)):
            raise ConnectionError(
                "TcpBoard: the board signs with another key, or none. Give the key of its "
                "key file: key=bytes.fromhex(...)."
            )
        self._keys: Keys = session_keys(key, first.payload, nonce)
        role = READER if read_only else WRITER
        answer = self.ask(Kind.HELLO, nonce + bytes([role]))
        return messages.unpack_welcome(answer.payload)

    def _send(self, kind: Kind, payload: bytes) -> None:
        self._sent += 1
        frame = Frame(kind, self._sent, int(monotonic() * 1e9), payload)
        self._socket.sendall(encode(frame, self._keys.to_board))

    def _receive(self, patience: float) -> Frame:
        deadline = monotonic() + patience
        try:
            while not self._waiting:
                self._socket.settimeout(max(deadline - monotonic(), 1e-4))
                data = self._socket.recv(4096)
                if not data:
                    raise ConnectionError("TcpBoard: the board closed the connection.")
                self._waiting += self._decoder.feed(data)
                if self._decoder.broken:
                    raise ConnectionError(f"TcpBoard: {self._decoder.broken}.")
            return self._waiting.pop(0)
        except TimeoutError as late:
            self._socket.close()
            raise ConnectionError(
                f"TcpBoard: no answer in {patience:g} s. The board vents by itself; make a "
                "new TcpBoard when it is back."
            ) from late
        except OSError:
            self._socket.close()
            raise
