"""The board on the network: sockets, and the clock that drives the state machine."""

import asyncio
import contextlib
from collections.abc import Callable
from time import monotonic

from sorojax_board.board import Board
from sorojax_board.legacy import LegacySession
from sorojax_board.session import Session

PORT, LEGACY_PORT = 5053, 8888
_LOOPBACK = ("127.0.0.1", "::1", "localhost")
_MOST_CLIENTS, _MOST_UNSENT = 8, 65536


class Server:
    """Serves one board until cancelled; ticks it 500 times a second.

    Args:
        board: The state machine.
        key: Shared key of 16 bytes or more; without one only this machine may connect.
        host: Address to bind.
        port: Of the framed protocol; 0 takes a free one.
        legacy_port: Also speak the raw stream of the first platform there, on this machine
            only.
        period: Between ticks [s].
        on_close: Called with the reason whenever a connection ends.

    Raises:
        ValueError: If the address is open to others without a key, or the key is short.
    """

    def __init__(
        self,
        board: Board,
        *,
        key: bytes = b"",
        host: str = "127.0.0.1",
        port: int = PORT,
        legacy_port: int | None = None,
        period: float = 0.002,
        on_close: Callable[[str], None] | None = None,
    ):
        if host not in _LOOPBACK and not key:
            raise ValueError(
                f"Server: got host {host} without a key, need one for an address that others "
                "reach. Make one with `python -m sorojax_board --new-key FILE`."
            )
        if key and len(key) < 16:
            raise ValueError(f"Server: the key has {len(key)} bytes, need 16 or more.")
        self.board = board
        self._key, self._host, self._period = key, host, period
        self._ports: dict[int, Callable] = {port: self._framed}
        if legacy_port is not None:
            self._ports[legacy_port] = self._raw
        self._on_close = on_close or (lambda reason: None)
        self._clients: dict = {}  # sessions and where to write to them
        self._tasks: set = set()
        self.port = port

    async def run(self, ready: Callable[[], None] | None = None) -> None:
        """Serve; the board is at zero and the sockets closed when this returns."""
        servers = []
        try:
            for port, make in self._ports.items():
                host = self._host if make == self._framed else "127.0.0.1"
                servers.append(await asyncio.start_server(self._client(make), host, port))
            self.port = servers[0].sockets[0].getsockname()[1]
            if ready is not None:
                ready()
            await self._tick()
        finally:
            for server in servers:
                server.close()
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
            self.board.vent(monotonic())
            with contextlib.suppress(OSError):
                self.board.backend.write([0.0] * self.board.num_ports)

    def _framed(self, now: float):
        return Session(self.board, self._key, now)

    def _raw(self, now: float):
        return LegacySession(self.board, now)

    async def _tick(self) -> None:
        due = monotonic()
        while True:
            now = monotonic()
            self.board.tick(now)
            for session, writer in self._clients.items():
                if beat := session.tick(now):
                    self._send(session, writer, beat)
            due = max(due + self._period, now)
            await asyncio.sleep(max(0.0, due - monotonic()))

    def _client(self, make: Callable):
        async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            if len(self._clients) >= _MOST_CLIENTS:
                writer.close()
                return
            session, task = make(monotonic()), asyncio.current_task()
            self._clients[session] = writer
            self._tasks.add(task)
            try:
                await self._talk(session, reader, writer)
            except OSError as reason:
                session.closed = session.closed or str(reason)
            finally:
                del self._clients[session]
                self._tasks.discard(task)
                session.lost(monotonic())
                self._on_close(session.closed)
                writer.close()

        return talk

    async def _talk(self, session, reader, writer) -> None:
        writer.write(session.challenge(monotonic()))
        while not session.closed:
            try:
                data = await asyncio.wait_for(reader.read(4096), 1.0)
            except TimeoutError:
                continue  # the watchdog judges silence, this only sees a session that ended
            if not data:
                return
            self._send(session, writer, session.receive(data, monotonic()))

    @staticmethod
    def _send(session, writer, data: bytes) -> None:
        if writer.is_closing():
            return
        writer.write(data)
        if writer.transport.get_write_buffer_size() > _MOST_UNSENT:
            session.closed = "the client does not read"
