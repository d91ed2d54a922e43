"""The command `sorojax`: run the main job, tell about the installation."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from sorojax import __version__
from sorojax.cli import cache, calibrate, robots, show


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status.

    A wrong input ends with one line and status 2; `SOROJAX_DEBUG=1` shows where it
    was raised.
    """
    arguments = _parser().parse_args(argv)
    if arguments.run not in (calibrate.run, cache.run) or getattr(arguments, "warm", False):
        _start_jax()
    if os.environ.get("SOROJAX_DEBUG"):
        return arguments.run(arguments)
    try:
        return arguments.run(arguments)
    except (ValueError, OSError) as error:
        print(f"sorojax: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("sorojax: interrupted", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sorojax", description="Differentiable soft robots in JAX."
    )
    parser.add_argument("--version", action="version", version=f"sorojax {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    demo = commands.add_parser("demo", help="from a drawing to a moving robot")
    demo.add_argument(
        "--out", type=Path, default=Path("out"), help="where results go (default: out)"
    )
    demo.add_argument("--quick", action="store_true", help="coarse mesh, short run")
    demo.set_defaults(run=_demo)

    info = commands.add_parser("info", help="versions, devices, solvers, cache")
    info.set_defaults(run=_info)
    for command in (robots, calibrate, show, cache):
        command.add(commands)
    return parser


def _demo(arguments: argparse.Namespace) -> int:
    from sorojax.cli import demo

    return demo.run(arguments.out, arguments.quick)


def _info(arguments: argparse.Namespace) -> int:
    from sorojax.cli.info import info

    rows = info()
    width = max(map(len, rows))
    for name, value in rows.items():
        print(f"{name:<{width}} {value}")
    return 0


def _start_jax() -> None:
    """Float64, the compilation cache and a device, as every command needs them."""
    if hasattr(os, "sched_getaffinity") and len(os.sched_getaffinity(0)) == 1:
        # With one worker thread a host callback can wait for itself.
        os.environ.setdefault("NPROC", "2")
        os.environ.setdefault("PJRT_NPROC", "2")
    import jax

    from sorojax._cache import enable_compilation_cache
    from sorojax._jax import devices

    jax.config.update("jax_enable_x64", True)
    enable_compilation_cache()
    devices.start()


if __name__ == "__main__":
    sys.exit(main())
