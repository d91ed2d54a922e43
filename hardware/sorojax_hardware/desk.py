"""`sorojax-bench serve` and `devices`: a simulated robot behind a board, and what is there."""

import argparse
import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sorojax_board.__main__ import read_key, run_server
from sorojax_board.board import Board, Settings
from sorojax_board.messages import Limits
from sorojax_board.server import LEGACY_PORT, PORT, Server
from sorojax_hardware.cameras import VideoCamera
from sorojax_hardware.realsense import realsense
from sorojax_hardware.serving import ModelValves
from sorojax_hardware.tcp_board import TcpBoard

ROBOTS = ("bending", "planar", "hand", "manipulator")
_BENCH = "sorojax.robots:bench"  # this package imports no model, it is told where to find one


def add_serve(make: Callable[..., argparse.ArgumentParser]) -> None:
    """The parser of `serve`."""
    parser = make("serve", serve, "a simulated robot behind a board on this machine")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--robot", choices=ROBOTS, help="one of the printable robots")
    what.add_argument(
        "--model",
        metavar="MODULE:FUNCTION",
        help="a model of your own: function(period [s]) -> (advance, state, limits), the "
        "first two as ModelValves takes them, limits [Pa] a pair per port",
    )
    parser.add_argument("--port", type=int, default=PORT)
    parser.add_argument("--host", default="127.0.0.1", help="address to bind")
    parser.add_argument("--key", type=Path, help="file with the shared key, mode 0600")
    parser.add_argument(
        "--legacy",
        action="store_true",
        help=f"also the raw float64 stream on port {LEGACY_PORT}",
    )
    parser.add_argument("--period", type=float, default=5.0, help="step of the model [ms]")


def serve(asked: argparse.Namespace) -> int:
    """Run until interrupted."""
    _prepare()
    if asked.robot is not None:  # what was compiled once is there at the next start
        importlib.import_module("sorojax").enable_compilation_cache()
    valves, settings = simulated(asked.robot, asked.model, asked.period * 1e-3)
    server = Server(
        Board(settings, valves),
        key=read_key(asked.key),
        host=asked.host,
        port=asked.port,
        legacy_port=LEGACY_PORT if asked.legacy else None,
    )
    run_server(server, f"simulated {asked.robot or asked.model} on {asked.host}")
    return 0


def simulated(
    robot: str | None, model: str | None = None, period: float = 0.005, **options: Any
) -> tuple[ModelValves, Settings]:
    """A robot by name, or any model, as valves and the limits of its board.

    Args:
        robot: One of `ROBOTS`, or None.
        model: "module:function" of a model, where `robot` is None.
        period: Step of the model [s].
        **options: Of `ModelValves`; 4 ms of dead time unless given.

    Returns:
        The valves, and the limits of a board for them.

    Raises:
        ImportError: If the module is not installed.
        ValueError: If it has no such function.
    """
    where, _, name = (model or _BENCH).partition(":")
    _prepare()
    make = getattr(importlib.import_module(where), name, None)
    if make is None:
        raise ValueError(f"{where} has no function {name!r}. Write MODULE:FUNCTION.")
    advance, state, limits = make(period) if robot is None else make(robot, period)
    settings = Settings(tuple(Limits(float(low), float(high), 2e6) for low, high in limits))
    options = {"period": period, "dead_time": 0.004} | options
    return ModelValves(advance, state, len(settings.limits), **options), settings


def _prepare() -> None:
    """Settings that count where JAX is not running yet."""
    os.environ.setdefault("JAX_ENABLE_X64", "1")  # mechanics needs it
    # threads cost more than they give to systems of 60 unknowns
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def add_devices(make: Callable[..., argparse.ArgumentParser]) -> None:
    """The parser of `devices`."""
    parser = make("devices", devices, "boards, webcams and depth cameras that answer")
    parser.add_argument("--most", type=int, default=4, help="webcam numbers to try")


def devices(asked: argparse.Namespace) -> int:
    """Print one line per kind of device."""
    for line in (_board(asked), *webcams(asked.most), _depth_cameras()):
        print(line)
    return 0


def _board(asked: argparse.Namespace) -> str:
    key = bytes.fromhex(asked.key.read_text().strip()) if asked.key else b""
    try:
        with TcpBoard(asked.host, asked.port, key=key, read_only=True, timeout=1.0) as board:
            low, high = (np.asarray(bound) * 1e-3 for bound in board.limits)
            return (
                f"board  {asked.host}:{asked.port}: {board.num_ports} ports, {low.min():g} to "
                f"{high.max():g} kPa, {board.report.state.name.lower()}"
            )
    except ConnectionError as reason:
        return f"board  none: {' '.join(str(reason).split())}"


def webcams(most: int) -> list[str]:
    """One line per webcam that opens."""
    found = []
    for number in range(most):
        try:
            camera = VideoCamera(number)
        except ConnectionError:
            continue
        image = camera.read()
        camera.close()
        size = "no image" if image is None else "x".join(map(str, image.colour.shape[1::-1]))
        found.append(f"camera {number}: {size}")
    return found or ["camera none opens"]


def _depth_cameras() -> str:
    try:
        found = realsense().context().query_devices()
    except ImportError as reason:
        return f"depth  none: {reason}"
    rs = realsense()
    names = [device.get_info(rs.camera_info.name) for device in found]
    return f"depth  {', '.join(names) or 'none connected'}"
