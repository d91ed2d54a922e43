"""`python -m sorojax_board`: run the board, simulated or real."""

import argparse
import asyncio
import contextlib
import os
import secrets
import signal
import stat
import sys
from pathlib import Path

from sorojax_board.bench import BenchValves
from sorojax_board.board import Board
from sorojax_board.config import read_config
from sorojax_board.i2c import I2CValves, open_bus
from sorojax_board.server import LEGACY_PORT, PORT, Server

INSTALLER = Path(__file__).parent / "raspberry_pi"


def arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sorojax_board", description=__doc__)
    parser.add_argument(
        "--backend",
        choices=("bench", "i2c"),
        default="bench",
        help="valves in memory, or the real ones",
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to bind")
    parser.add_argument("--port", type=int, default=PORT)
    parser.add_argument("--key", type=Path, help="file with the shared key, mode 0600")
    parser.add_argument("--config", type=Path, help="JSON: ports, watchdog, ramp, wiring, ...")
    parser.add_argument(
        "--legacy",
        action="store_true",
        help=f"also the raw float64 stream on port {LEGACY_PORT}",
    )
    parser.add_argument("--new-key", type=Path, help="write a new key there and stop")
    parser.add_argument(
        "--installer",
        action="store_true",
        help="print where that of a Raspberry Pi is and stop",
    )
    return parser


def new_key(path: Path) -> None:
    """A random key, readable by its owner only."""
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(handle, "w") as file:
        file.write(secrets.token_hex(32) + "\n")


def read_key(path: Path | None) -> bytes:
    """The key in a file.

    Raises:
        PermissionError: If others may read the file.
        ValueError: If it is no key.
    """
    if path is None:
        return b""
    if os.name == "posix" and path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise PermissionError(f"{path} is open to others, need mode 0600. chmod 600 {path}")
    try:
        key = bytes.fromhex(path.read_text().strip())
    except ValueError as wrong:
        raise ValueError(
            f"{path} holds no key, need hexadecimal digits. Make one with --new-key."
        ) from wrong
    if len(key) < 16:
        raise ValueError(f"{path} holds {len(key)} bytes, need 16 or more. Use --new-key.")
    return key


def main(argv: list[str] | None = None) -> int:
    asked = arguments().parse_args(argv)
    if asked.installer:
        print(INSTALLER)
        return 0
    try:
        if asked.new_key:
            new_key(asked.new_key)
            return 0
        chosen, wiring = read_config(asked.config)
        if asked.backend == "i2c":
            buses = {number: open_bus(number) for number in {wire.bus for wire in wiring}}
            backend = I2CValves(buses, wiring)
        else:
            backend = BenchValves(len(chosen.limits))
        server = Server(
            Board(chosen, backend),
            key=read_key(asked.key),
            host=asked.host,
            port=asked.port,
            legacy_port=LEGACY_PORT if asked.legacy else None,
            on_close=lambda reason: print(f"connection closed: {reason}", flush=True),
        )
    except (OSError, ValueError, ImportError) as wrong:
        print(f"sorojax_board: {wrong}", file=sys.stderr)
        return 2
    run_server(server, f"{asked.backend} board on {asked.host}")
    return 0


def run_server(server: Server, name: str) -> None:
    """Serve until the process is asked to end; the valves are at zero then."""
    asyncio.run(_serve(server, name))


async def _serve(server: Server, name: str) -> None:
    work = asyncio.ensure_future(server.run(lambda: print(f"{name}:{server.port}", flush=True)))
    for number in (signal.SIGTERM, signal.SIGINT) if os.name == "posix" else ():
        asyncio.get_running_loop().add_signal_handler(number, work.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        await work


if __name__ == "__main__":
    sys.exit(main())
