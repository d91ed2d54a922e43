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
_MOST_CLIENTS, _MOST_STRANGERS, _MOST_UNSENT = 8, 128, 65536


class Server:
    """Serves one board until cancelled; ticks it 500 times a second.

    Nobody is turned away at the door, as anybody with the key may come to stop the robot:
    where places run out, the eldest connection that has not said hello gives its own, or
    the client that was silent longest. The writer keeps its place.

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
                if session.closed:
                    writer.transport.abort()
            due = max(due + self._period, now)
            await asyncio.sleep(max(0.0, due - monotonic()))

    def _client(self, make: Callable):
        async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            session, task = make(monotonic()), asyncio.current_task()
            self._clients[session] = writer
            self._tasks.add(task)
            self._make_room()
            try:
                await self._talk(session, reader, writer)
            except OSError as reason:
                session.closed = session.closed or str(reason)
            except asyncio.CancelledError:  # nobody waits for this task but `run`
                session.closed = session.closed or "the board stops"
            finally:
                del self._clients[session]
                self._tasks.discard(task)
                session.lost(monotonic())
                self._on_close(session.closed)
                writer.close()

        return talk

    def _make_room(self) -> None:
        now = monotonic()
        strangers = [one for one in self._clients if not (one.ready or one.closed)]
        known = [one for one in self._clients if one.ready and not one.closed]
        quiet = [one for one in known if one is not self.board.owner]
        quiet.sort(key=lambda one: one.last_heard)
        spare = strangers[: max(len(strangers) - _MOST_STRANGERS, 0)]
        for one in (*spare, *quiet[: max(len(known) - _MOST_CLIENTS, 0)]):
            one.close("another client needed its place", now)
            self._clients[one].transport.abort()

    async def _talk(self, session, reader, writer) -> None:
        writer.write(session.challenge(monotonic()))
        while not session.closed:
            data = await reader.read(4096)
            if not data:
                return
            known = session.ready
            self._send(session, writer, session.receive(data, monotonic()))
            if session.ready and not known:
                self._make_room()

    @staticmethod
    def _send(session, writer, data: bytes) -> None:
        if writer.is_closing():
            return
        writer.write(data)
        if writer.transport.get_write_buffer_size() > _MOST_UNSENT:
            session.closed = "the client does not read"
