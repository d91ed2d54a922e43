"""Cost against size: the observed exponent beside the expected one, memory beside both."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from benchmarks import memory
from benchmarks.harness import Row, Timing, measure


class Point(NamedTuple):
    """What one size took."""

    size: int
    timing: Timing
    peak_MB: float | None
    more: dict[str, Any] = {}


def rows(what: str, of: str, expected: float, points: Iterable[Point]) -> Iterator[Row]:
    """Rows of `what` over the size `of`, as soon as they are measured.

    `exponent` is that between a size and the one before, from the shortest runs; `expected`
    is what the count of operations says for large sizes.
    """
    last: Point | None = None
    for point in points:
        settings = {
            "method": what,
            "against": of,
            of: point.size,
            "expected": round(expected, 2),
        }
        if last is not None:
            settings["exponent"] = round(exponent(last, point), 2)
        if point.peak_MB is not None:
            settings["peak_MB"] = round(point.peak_MB, 2)
        yield Row("sorojax", settings | point.more, **point.timing.columns())
        last = point


def exponent(before: Point, after: Point) -> float:
    ratio = min(after.timing.runs) / min(before.timing.runs)
    return float(np.log(ratio) / np.log(after.size / before.size))


def program(size: int, function: Callable, *args: Any, calls: int = 1, repeats: int = 5):
    """The point of a JAX function that makes `calls` calls."""
    compiled: list[Any] = []
    timing = measure(function, *args, repeats=repeats, keep=compiled.append)
    return Point(size, timing.per(calls), memory.of_program(compiled[0]))
