"""`sorojax cache`: how many compiled programs are kept, deleting them, and compiling some."""

import argparse
import tempfile
import time
from pathlib import Path

from sorojax._cache import cache_directory, cached_programs, clear_compilation_cache


def add(commands) -> None:
    parser = commands.add_parser("cache", help="compiled programs that are kept")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--info", action="store_true", help="folder, count, size (default)")
    what.add_argument("--clear", action="store_true", help="delete all of them")
    what.add_argument(
        "--warm",
        action="store_true",
        help="compile what `sorojax demo` needs, from a drawing to a moving robot",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    if arguments.clear:
        print(f"{clear_compilation_cache()} programs deleted")
    elif arguments.warm:
        return _warm()
    else:
        count, size = cached_programs()
        print(
            f"{cache_directory()}\n{count} programs, {size:.1f} MB, for this type of processor"
        )
    return 0


def _warm() -> int:
    from sorojax.cli import demo

    before, start = cached_programs()[0], time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        status = demo.run(Path(folder), False)
    made, seconds = cached_programs()[0] - before, time.perf_counter() - start
    print(f"{made} programs more in {seconds:.0f} s")
    return status
