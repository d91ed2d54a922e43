"""A connection that goes wrong on request, to see what a board and a program make of it."""

import contextlib
import socket
import struct
import threading
import time


class DisturbedLink:
    """Passes bytes between clients and a board, as `with DisturbedLink(board_port) as link`.

    Connect to `link.port`. `delay` [s] holds every piece back, `cut()` breaks the connections
    off, and after `freeze()` they stay open and nothing passes any more, as when a cable is
    drawn behind a switch.
    """

    def __init__(self, board_port: int, host: str = "127.0.0.1"):
        self._board, self.delay = (host, board_port), 0.0
        self._frozen, self._sockets = threading.Event(), []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """End every connection at once, with a reset."""
        for one in self._sockets:
            with contextlib.suppress(OSError):
                one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                one.shutdown(socket.SHUT_RDWR)
                one.close()
        self._sockets.clear()

    def freeze(self) -> None:
        """Pass nothing from now on, and close nothing."""
        self._frozen.set()

    def __enter__(self) -> "DisturbedLink":
        return self

    def __exit__(self, *_) -> None:
        self._listener.close()
        self.cut()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client = self._listener.accept()[0]
                board = socket.create_connection(self._board)
                for one in (client, board):
                    one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._sockets += [client, board]
                for ends in ((client, board), (board, client)):
                    threading.Thread(target=self._pass, args=ends, daemon=True).start()

    def _pass(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(4096):
                if self.delay:
                    time.sleep(self.delay)
                if not self._frozen.is_set():
                    sink.sendall(data)
            if not self._frozen.is_set():
                sink.shutdown(socket.SHUT_WR)
