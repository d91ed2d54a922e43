"""Random programs, compiled by `sorojax.jit` and as usual: the same answers, and no abort.

    python -m tests.fuzz_kernels --programs 2000 --seed 0
    python -m tests.fuzz_kernels --only 123     # prints one program, and runs it here

XLA ends the process for some programs in a kernel. So programs run in child processes, and
one that ends its process costs one program. A program follows from its seed alone. Its
operations are damped and its decisions are taken at odd numbers: rounding stays rounding.
"""

import argparse
import gc
import json
import math
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import xla_metadata

WHOLE = ("int32", "int64", "uint32")
SELDOM = ("uint64", "int16", "uint8")
SIZES = (0, 1, 2, 3, 3, 4, 5, 6, 8, 12, 17, 40, 130, 300)
TOLERANCE = {"float64": 1e-10, "float32": 1e-4}
DEEPEST = 3  # loops and branches inside of others
BATCH = 250  # programs of one process
THREADED = 4  # every so many batches run in threads
SHORT = 25  # operations: in every other batch a kernel holds no longer loop, but those within
ENOUGH = 0.6  # of the programs have a kernel, or the others show little
BAD = {
    "abort": "aborts",
    "result": "wrong results",
    "dtype": "wrong dtypes",
    "error": "other errors",
}
FATAL = ("Check failed", "LLVM ERROR", "Assertion", "terminate called", "Error")
ROOT = Path(__file__).parent.parent
Shape = tuple[int, ...]
_last = threading.local()  # the program that a thread has traced


class Draw:
    """Choices that follow from a name: traced twice, a function is the same program."""

    def __init__(self, name: str, floats: Any, depth: int = 0, back: bool = False):
        self.name, self.floats, self.depth, self.back = name, floats, depth, back
        numbers = random.Random(name)
        self.one, self.number, self._random = numbers.choice, numbers.randint, numbers.random

    def chance(self, part: float) -> bool:
        return self._random() < part

    def inside(self, what: Any, deeper: int = 0, back: bool = False) -> "Draw":
        name = f"{self.name}/{what}"
        return Draw(name, self.floats, self.depth + deeper, self.back or back)

    def real(self) -> str:
        return self.one(self.floats)

    def whole(self) -> str:
        return self.one(SELDOM if self.chance(0.05) else WHOLE)

    def kind(self) -> str:
        return self.one((self.real(), self.real(), self.whole(), "bool"))

    def shape(self) -> Shape:
        size = self.one(SIZES)
        return self.one(((), (size,), (size,), (self.number(1, 4), min(size, 9))))


def constant(draw: Draw, kind: str, shape: Shape, pool: list[Any]) -> Any:
    """Known early, or found late."""
    size, floats, way = math.prod(shape), kind in draw.floats, draw.number(0, 4)
    like = [x for x in pool if x.dtype == kind != "bool"]
    if way == 0:
        return jnp.zeros(shape, kind)
    if way == 1:
        return jnp.full(shape, draw.one((0.37, 1, -0.6) if floats else (0, 1, 3)), kind)
    if way == 2 and like:
        return fit(draw, 0 * finite(draw.one(like)), shape)
    if way == 3 and kind != "bool":
        count = lax.iota(kind, size).reshape(shape)
        return count / max(size, 1) if floats else lax.rem(count, lax.full_like(count, 7))
    table = np.arange(size).reshape(shape) % 5
    return jnp.asarray((np.cos(table) if floats else table % 3).astype(kind))


def finite(x: Any) -> Any:
    return lax.select(abs(x) < 9, x, lax.full_like(x, 0))


def fit(draw: Draw, x: Any, shape: Shape) -> Any:
    """`x` in another shape: a part of it, repeated, or one of its entries."""
    size, flat = math.prod(shape), x.reshape(-1)
    if x.shape == shape:
        return x
    if not size or not x.size:
        return jnp.zeros(shape, x.dtype)
    if x.size == 1 or draw.chance(0.2):
        return jnp.broadcast_to(flat[draw.number(0, x.size - 1)], shape)
    if draw.chance(0.2):
        return flat[(jnp.arange(size) * 3 + 1) % x.size].reshape(shape)
    if x.size >= size:
        return lax.slice(flat, (x.size - size,), (x.size,)).reshape(shape)
    return (
        jnp.resize(x, shape)
        if draw.chance(0.5)
        else jnp.pad(flat, (0, size - x.size)).reshape(shape)
    )


def cast(draw: Draw, x: Any, kind: str) -> Any:
    """`x` as another kind of number, where the answer is the same on every machine."""
    was, floats = x.dtype.name, kind in draw.floats
    if was in draw.floats and not floats:
        odd = jnp.floor(finite(x) * 4 + 0.3137)
        return odd > 0 if kind == "bool" else jnp.abs(odd).astype(kind)
    if was in draw.floats or was in (kind, "bool") or not floats and kind != "bool":
        return x.astype(kind)
    rest = lax.rem(x, lax.full_like(x, 17))
    return rest.astype(kind) / 17 if floats else rest > 5


def value(draw: Draw, pool: list[Any], kind: str, shape: Shape | None = None) -> Any:
    """One of `pool`, made to be of `kind` and `shape`, or a constant."""
    if draw.chance(0.1) or not pool:
        return constant(draw, kind, draw.shape() if shape is None else shape, pool)
    alike = [x for x in pool if x.dtype == kind]
    x = cast(draw, draw.one(alike if alike and draw.chance(0.9) else pool), kind)
    return x if shape is None else fit(draw, x, shape)


def some(draw: Draw, pool: list[Any], least: int, most: int) -> list[Any]:
    return [value(draw, pool, draw.kind()) for _ in range(draw.number(least, most))]


def of_one(draw: Draw, pool: list[Any]) -> Any:
    """Sine and cosine often: loops around them are made anew."""
    return draw.one((
        *(jnp.sin, jnp.cos) * 8, jnp.tanh, jnp.arctan, jnp.abs, lax.neg, lax.erf, lax.logistic,
        lambda x: 0.9 * x, lambda x: jnp.exp(-(x**2)), lambda x: jnp.log1p(x**2) / 2,
        lambda x: jnp.sqrt(1 + x**2) - 1, lambda x: jnp.clip(x, -0.7, 0.6), lambda x: x * 0,
        lambda x: jnp.round(4 * jnp.tanh(x) + 0.137) / 4, lambda x: jnp.sign(x + 0.1379),
        lambda x: jnp.arctan2(x, 1.5 + x * x), lambda x: jnp.where(x > 0.913, jnp.nan, x),
        lambda x: lax.stop_gradient(x) / 2, lambda x: jnp.sinh(jnp.tanh(x)) / 2,
        lambda x: jnp.cbrt(1 + x * x) / 2, lambda x: jnp.expm1(-(x**2)), jnp.arcsinh,
        lambda x: lax.rsqrt(1 + x * x), lambda x: jnp.log(1.5 + x * x) / 2, jnp.square,
        lambda x: jnp.exp2(-x * x) / 2, lambda x: (1.5 + x * x) ** -0.3, lax.erfc,
        lambda x: jnp.arcsin(0.9 * jnp.tanh(x)) / 3, lambda x: jnp.arctanh(jnp.tanh(x) / 2),
        lambda x: jnp.ceil(3 * jnp.tanh(x) + 0.137) / 4, lambda x: jnp.cosh(jnp.tanh(x)) / 2,
        lambda x: jnp.arccos(0.9 * jnp.tanh(x)) / 3, lambda x: jnp.tan(jnp.tanh(x)) / 2,
        lambda x: lax.clamp(lax.full_like(x, -0.7), x, lax.full_like(x, 0.6)),
        lambda x: jnp.arccosh(1.5 + x * x) / 3, lambda x: lax.erf_inv(jnp.tanh(x) / 2),
    ))(value(draw, pool, draw.real()))  # fmt: skip


def of_two(draw: Draw, pool: list[Any]) -> Any:
    x = value(draw, pool, draw.real())
    return draw.one((
        lambda x, y: (x + y) / 2, lambda x, y: x * y / 2, lambda x, y: (x - y) / 2,
        lambda x, y: x / (1.5 + y * y), jnp.maximum, jnp.minimum,
        lambda x, y: jnp.where(value(draw, pool, "bool", x.shape), x, y),
    ))(x, value(draw, pool, x.dtype.name, x.shape))  # fmt: skip


def of_whole(draw: Draw, pool: list[Any]) -> Any:
    x = value(draw, pool, draw.whole())
    y = value(draw, pool, x.dtype.name, x.shape)
    return draw.one((
        lambda: x + y, lambda: x - y, lambda: x * y, lambda: x ^ y, lambda: x & y,
        lambda: x | y, lambda: ~x, lambda: x // 3, lambda: x % ((y & 7) + 1), lambda: x << 1,
        lambda: jnp.minimum(x, y), lambda: jnp.where(x > y, x, y), lambda: jnp.clip(x, 1, 5),
        lambda: jnp.cumsum(x), lambda: jnp.sum(x), lambda: jnp.max(x, initial=2),
        lambda: jnp.argmax(jnp.append(x, 3)), lambda: jnp.argmin(jnp.append(y, 3)),
        lambda: jnp.sort(x, None), lambda: abs(x), lambda: jnp.vdot(x, y),
    ))()  # fmt: skip


def of_truth(draw: Draw, pool: list[Any]) -> Any:
    x = value(draw, pool, "bool")
    y, z = value(draw, pool, "bool", x.shape), value(draw, pool, draw.real())
    return draw.one((
        lambda: x & y, lambda: x | y, lambda: x ^ y, lambda: ~x, lambda: jnp.any(x),
        lambda: jnp.all(x), lambda: z > 0.1237, lambda: z <= 0.3719, lambda: jnp.isfinite(z),
        lambda: value(draw, pool, draw.whole()) < 2, lambda: jnp.sum(x),
    ))()  # fmt: skip


def of_all(draw: Draw, pool: list[Any]) -> Any:
    """Sums, products, sorted numbers."""
    x = jnp.atleast_1d(value(draw, pool, draw.real()))
    flat, last, count = x.reshape(-1), x.shape[-1], max(x.size, 1)
    row = value(draw, pool, x.dtype.name, (last,))
    table = value(draw, pool, x.dtype.name, (draw.number(1, 5), last))
    return draw.one((
        lambda: jnp.sum(x) / count, lambda: jnp.sum(x, -1) / count, lambda: jnp.mean(table, 0),
        lambda: jnp.cumsum(flat) / count, lambda: jnp.prod(jnp.tanh(x)), lambda: jnp.sort(flat),
        lambda: jnp.max(x, initial=-0.3), lambda: jnp.min(table, 0, initial=0.4),
        lambda: table @ row / count, lambda: table @ table.T / count, lambda: x @ row / count,
        lambda: x @ table.T / count, lambda: jnp.einsum("ij,ij->i", table, table) / count,
        lambda: jnp.outer(flat[:5], row[:6]) / 2, lambda: jnp.vdot(table, table) / 5 / count,
    ))()  # fmt: skip


def of_matrix(draw: Draw, pool: list[Any]) -> Any:
    """Factors and solutions."""
    n, kind = draw.number(1, 6), draw.real()
    table = jnp.tanh(finite(value(draw, pool, kind, (n, n))))
    right = finite(value(draw, pool, kind, draw.one(((n,), (n, 2)))))
    one = jnp.eye(n, dtype=kind)
    even, other = 2 * one + table @ table.T / n, 1.3 * one[::-1] + table / (2 * n)
    how = {
        "lower": draw.chance(0.5),
        "transpose_a": draw.chance(0.5),
        "unit_diagonal": draw.chance(0.3),
    }
    wide = (right.T if right.ndim > 1 else right[None]) / 4
    return draw.one((
        lambda: jnp.linalg.cholesky(even), lambda: jnp.linalg.solve(even, right),
        lambda: jnp.tanh(jnp.linalg.solve(other, right)),
        lambda: lax.linalg.triangular_solve(even, wide, **how),
        lambda: jax.grad(lambda x: jnp.sum(jnp.linalg.solve(even, x) ** 2))(right),
        lambda: jax.grad(lambda x: jnp.sum(jnp.linalg.inv(even + jnp.diag(x))))(table[0] / 4),
        lambda: jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(even), right),
    ))()  # fmt: skip


def of_parts(draw: Draw, pool: list[Any]) -> Any:
    """Parts of arrays, and arrays of parts."""
    x = value(draw, pool, draw.kind())
    flat = x.reshape(-1) if x.size else jnp.ones(2, x.dtype)
    at, size = value(draw, pool, draw.one(WHOLE), ()) % 9, draw.number(1, flat.size)
    new = value(draw, pool, x.dtype.name, (size,))
    return draw.one((
        lambda: lax.dynamic_slice(flat, (at,), (size,)), lambda: flat[at % flat.size],
        lambda: lax.dynamic_update_slice(flat, new, (at,)), lambda: flat.at[at].set(new[0]),
        lambda: flat[(jnp.arange(size) + at) % flat.size], lambda: flat[::-1], lambda: x.T,
        lambda: jnp.concatenate([flat[:3], new]), lambda: jnp.roll(flat, 1), lambda: flat[:0],
        lambda: jnp.stack([flat, flat[::-1]])[:, :9], lambda: jnp.tile(flat[:7], 2),
        lambda: jnp.where(jnp.arange(flat.size) == at, flat[0], flat), lambda: x[None],
    ))()  # fmt: skip


def follow(draw: Draw, x: Any, pool: list[Any]) -> Any:
    """What comes after `x` in a loop: itself, a constant that forgets it, or something else."""
    way = draw.number(0, 9)
    if way == 0:
        return x
    if way == 1:
        return constant(draw, x.dtype.name, x.shape, pool)
    new = value(draw, pool, x.dtype.name, x.shape)
    return (x + jnp.tanh(new)) / 2 if x.dtype.name in draw.floats and way < 6 else new


def after(draw: Draw, state: Any, rest: list[Any]) -> list[Any]:
    """The next state; that of some loops depends on nothing."""
    if draw.chance(0.15):
        return [constant(draw, x.dtype.name, x.shape, list(state)) for x in state]
    made = block(draw, [*state, *rest])
    return [follow(draw.inside(f"next {k}"), x, made) for k, x in enumerate(state)]


def loop(draw: Draw, pool: list[Any]) -> list[Any]:
    state, rest = some(draw, pool, 0, 3), [x for x in pool if draw.chance(0.4)]
    body, count = draw.inside("body", deeper=1), draw.one((0, 1, 2, 3, 5, 9))
    way = draw.one((scan, scan, counted) + (() if draw.back else (often, until, shrinking)))
    return jax.tree.leaves(way(draw, pool, body, state, rest, count))


def scan(draw: Draw, pool: Any, body: Draw, state: Any, rest: Any, count: int) -> Any:
    shapes = (count,), (count, 3), (count, 2, 2)
    several = range(draw.one((0, 1, 1, 2)))
    rows = [value(draw, pool, draw.kind(), draw.one(shapes)) for _ in several]

    def step(state: Any, row: list[Any]) -> Any:
        new = after(body, state, [*rest, *row])
        return new, some(body.inside("out"), [*new, *row, *rest], 0, 2)

    unroll = draw.one((2, True)) if 0 < count < 6 and draw.chance(0.2) else 1
    return lax.scan(step, state, rows, count, reverse=draw.chance(0.5), unroll=unroll)


def counted(draw: Draw, pool: Any, body: Draw, state: Any, rest: Any, count: Any) -> Any:
    return lax.fori_loop(0, count, lambda i, state: after(body, state, [*rest, i]), state)


def often(draw: Draw, pool: Any, body: Draw, state: Any, rest: Any, count: int) -> Any:
    """As often as a number says."""
    number = value(draw, pool, draw.one(("int32", "int64")), ()) % 5
    return counted(draw, pool, body, state, rest, number)


def until(draw: Draw, pool: Any, body: Draw, state: Any, rest: Any, count: int) -> Any:
    """Until something holds."""

    def goes_on(state: Any) -> Any:
        made = block(body.inside("test", deeper=DEEPEST), [*state[1], *rest])
        return (state[0] < count) & value(body.inside("on"), made, "bool", ())

    def turn(state: Any) -> Any:
        return state[0] + 1, after(body, state[1], [*rest, state[0]])

    return lax.while_loop(goes_on, turn, (jnp.zeros((), draw.one(WHOLE)), state))


def shrinking(draw: Draw, pool: Any, body: Draw, state: Any, rest: Any, count: int) -> Any:
    """Until little is left."""
    kind = draw.one((*draw.floats, *WHOLE))
    much = value(draw, pool, kind)
    much = jnp.clip(much, -2, 3) if kind in draw.floats else much % 9

    def turn(state: Any) -> Any:
        less = state[0] * 0.6 if kind in draw.floats else state[0] // 2
        return less, after(body, state[1], [*rest, less])

    return lax.while_loop(lambda state: jnp.any(state[0] > 0.1237), turn, (much, state))


def branch(draw: Draw, pool: list[Any]) -> list[Any]:
    state, rest = some(draw, pool, 1, 2), [x for x in pool if draw.chance(0.3)]
    ways = [lambda *s, k=k: after(draw.inside(k, deeper=1), s, rest) for k in range(3)]
    if draw.chance(0.6):
        return lax.cond(value(draw, pool, "bool", ()), *ways[:2], *state)
    return lax.switch(value(draw, pool, "int32", ()) % 4, ways, *state)


def around(draw: Draw, pool: list[Any]) -> list[Any]:
    """A loop in a function of its own: compiled, batched, differentiated."""
    way = draw.one(("jit", "vmap", "grad", "grad", "jvp", "checkpoint"))
    rest, x = [x for x in pool if draw.chance(0.4)], value(draw, pool, draw.real())
    inner = draw.inside(way, back=way in ("grad", "checkpoint"))
    if way == "jit":  # the last argument is not used
        return jax.jit(lambda used, _: block(inner, used, loops=1)[-2:])([x, *rest], x)

    def one(x: Any) -> Any:
        made = block(inner, [x, *rest], loops=1)[-2:]
        return (x + jnp.tanh(value(inner.inside("end"), made, x.dtype.name, x.shape))) / 2

    if way == "vmap":
        return [jax.vmap(one)(jnp.stack([x, x / 2, x * 0][: draw.number(1, 3)]))]
    if way == "jvp":
        return [jnp.tanh(y) for y in jax.jvp(one, (x,), (jnp.ones_like(x),))]
    inside = jax.checkpoint(one) if way == "checkpoint" else one
    return [jnp.tanh(jax.grad(lambda x: jnp.sum(inside(x)) / 2)(x))]


@jax.custom_jvp
def ruled(x: Any) -> Any:
    return jnp.tanh(x) / 2


ruled.defjvps(lambda slope, _, x: jnp.cos(x) * slope / 3)


@jax.custom_vjp
def pulled(x: Any) -> Any:
    return jnp.sin(x) / 2


pulled.defvjp(lambda x: (pulled(x), x), lambda x, slope: (slope * jnp.exp(-x * x),))


def with_rules(draw: Draw, pool: list[Any]) -> list[Any]:
    """Functions with derivatives of their own, in a loop and by themselves."""
    x, forward = value(draw, pool, draw.real()), "/jvp/" in draw.name
    own = draw.one((ruled, solved) if forward else (ruled, solved, pulled))

    def run(x: Any) -> Any:
        return lax.fori_loop(0, 3, lambda _, x: own(x) + x / 4, x)

    return [own(x), run(x), jax.grad(lambda x: jnp.sum(run(x)) / 2)(x)]


def solved(x: Any) -> Any:
    solve = lambda _, right: right / 1.7  # noqa: E731
    return lax.custom_linear_solve(lambda y: 1.7 * y, x, solve, solve)


EASY = [of_one] * 8 + [of_two] * 4 + [of_whole] * 2 + [of_truth, *[of_all] * 2]
EASY += [of_parts] * 3 + [of_matrix] * 2
DEEP = [loop] * 4 + [branch] * 3 + [around] * 4 + [with_rules]


def block(draw: Draw, pool: list[Any], loops: int = 0) -> list[Any]:
    """`pool` and what a few operations make of it."""
    pool = list(pool)
    for k in range(loops + draw.number(1, 2 if draw.depth else 3)):
        step = draw.inside(k)
        deep = draw.depth < DEEPEST and step.chance(0.5 * 0.4**draw.depth)
        made = (loop if k < loops else step.one(DEEP if deep else EASY))(step, pool)
        pool += made if isinstance(made, list | tuple) else [made]
    return pool


class Program:
    """A function, arguments for it, and how often it was traced and its loops were marked."""

    def __init__(self, seed: int):
        floats = ("float64",), ("float64",), ("float32",), ("float64", "float32")
        self.draw = Draw(str(seed), random.Random(f"{seed}/floats").choice(floats))
        draw = self.draw.inside("arguments")
        self.seed, self.traces, self.marks = seed, 0, 0
        self.tolerance = max(TOLERANCE[kind] for kind in self.draw.floats)
        self.kinds = [(draw.kind(), draw.shape()) for _ in range(draw.one((0, 1, 2, 2, 3, 4)))]
        self.is_compiled = draw.chance(0.1)  # by `sorojax.compiled`
        self.how = draw.one((None, "name", 3, 0.5))
        self.table = np.linspace(-1, 1, 7).astype(self.draw.floats[0])
        self.count = jax.device_put(np.arange(3))

    def arguments(self, special: bool = False) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """By place and by name; `special` ones are zeros, ones, and not finite."""
        numbers, arrays = np.random.RandomState(self.seed % 2**32), []
        for k, (kind, shape) in enumerate(self.kinds):
            x = numbers.uniform(-1.2, 1.2, shape)
            if kind not in self.draw.floats:
                x = np.full(shape, k % 2) if special else np.abs(x * 7) // 1
            elif special:
                x = np.where(numbers.uniform(size=shape) < 0.3, (np.nan, 0)[k % 2], x)
            x = np.asarray(x).astype(kind)
            arrays.append(x if k == 2 else jax.device_put(x))
        if self.is_compiled:
            return tuple(arrays), {}
        return (*arrays[:2], {"rest": arrays[2:], "how": self.how}), {"how": self.how}

    def __call__(self, *args: Any, **named: Any) -> Any:
        self.traces, _last.program = self.traces + 1, self
        arrays = [jnp.asarray(x) for x in jax.tree.leaves((args, named)) if eqx.is_array(x)]
        pool = [*arrays, jnp.asarray(self.table), self.count]
        if isinstance(named.get("how"), float):
            pool.append(pool[-2] * named["how"])
        made = block(self.draw.inside("made"), pool, loops=1)
        draw = self.draw.inside("answer")
        last = [*made[-3:], *(draw.one(made) for _ in range(3))]
        if self.is_compiled:
            return last
        return {"last": last, "again": last[0], "given": arrays[:1], "how": self.how, "of": 2}

    def plain(self) -> Callable[..., Any]:
        return eqx.filter_jit(lambda *args, **named: self(*args, **named))


def check(seed: int, fault: str = "", callers: int = 1) -> dict[str, Any]:
    """One program, called by some threads at once: what differs, and whether a kernel ran."""
    import sorojax as sj

    program = Program(seed)
    cases = [program.arguments(special) for special in (False, True)]
    try:
        plain = program.plain()
        want = [plain(*args, **named) for args, named in cases]
        traces = program.traces
        call = sj.compiled(program, *cases[0][0]) if program.is_compiled else sj.jit(program)
        call = faulty(call, fault) if fault else call
        with ThreadPoolExecutor(callers) as crowd:
            calls = [crowd.submit(call, *args, **named) for args, named in cases * callers]
        pairs = zip([each.result() for each in calls], want * callers, strict=True)
        found = [compare(*pair, program.tolerance) for pair in pairs]
    except Exception as error:
        return {"kind": "error", "text": f"{type(error).__name__}: {error}"[:2000]}
    kind, text = next(filter(None, found), ("", ""))
    if kind == "result" and not is_settled(program, want):
        kind = "undecided"
    accepted = callers > 1 or program.traces == traces + 1  # what is refused is traced again
    return {"kind": kind, "text": text, "kernel": program.marks > 0 and accepted}


def compare(found: Any, want: Any, tolerance: float) -> tuple[str, str] | None:
    """The kind of a difference, and where it is."""
    trees = jax.tree.structure(found), jax.tree.structure(want)
    if trees[0] != trees[1]:
        return "dtype", f"the structure {trees[0]}, not {trees[1]}"
    for place, (x, y) in enumerate(zip(*map(jax.tree.leaves, (found, want)), strict=True)):
        if not eqx.is_array(y):
            if type(x) is not type(y) or x != y:
                return "dtype", f"leaf {place}: {x!r}, not {y!r}"
            continue
        if (x.dtype, x.shape, x.weak_type) != (y.dtype, y.shape, y.weak_type):
            return "dtype", f"leaf {place}: {x.aval}, not {y.aval}"
        a, b = np.asarray(x), np.asarray(y)
        floats = b.dtype.kind == "f"
        if not (np.allclose(a, b, tolerance, tolerance, True) if floats else (a == b).all()):
            return "result", f"leaf {place}: {a}, not {b}"
    return None


def is_settled(program: Program, want: list[Any]) -> bool:
    """Whether the usual answers stay where arguments move by rounding."""

    def move(x: Any) -> Any:
        if not eqx.is_array(x) or x.dtype.kind != "f":
            return x
        signs = np.random.RandomState(1).choice([-4, 4], x.shape)
        return jax.device_put((x * (1 + signs * np.finfo(x.dtype).eps)).astype(x.dtype))

    plain = program.plain()
    for special in (False, True):
        args, named = jax.tree.map(move, program.arguments(special))
        if compare(plain(*args, **named), want[special], program.tolerance / 4):
            return False
    return True


def faulty(call: Callable[..., Any], fault: str) -> Callable[..., Any]:
    """`call` gone wrong, to see that it is noticed."""
    wrong = {
        "abort": lambda x: os.abort(),
        "result": lambda x: ~x if x.dtype == bool else x + 1,
        "dtype": lambda x: x.astype("int32" if x.dtype == "float32" else "float32"),
        "error": lambda x: x.no_such_thing,
    }[fault]

    def broken(*args: Any, **named: Any) -> Any:
        found = call(*args, **named)
        return jax.tree.map(lambda x: wrong(x) if eqx.is_array(x) else x, found)

    return broken


def prepare(seed: int) -> None:
    """Double precision, nothing kept on disk, kernels on every jaxlib, and counted; for the
    batch of `seed`."""
    gc.set_threshold(100_000, 20, 20)  # tracing makes so many objects
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", False)
    plain = xla_metadata.set_xla_metadata

    def counted(*args: Any, **marks: Any) -> Any:
        if marks.get("xla_cpu_small_call") == "true":
            _last.program.marks += 1
        return plain(*args, **marks)

    xla_metadata.set_xla_metadata = counted  # before sorojax looks it up
    from sorojax._jax import small_kernels as kernels

    kernels.PROVEN = (*kernels.PROVEN, metadata.version("jaxlib"))
    kernels._IS_PROVEN = kernels.status() == "on"
    if seed // BATCH % 2:
        kernels.LONGEST = SHORT


def serve(seeds: list[int], threads: int, fault: str) -> None:
    """In a child process: a line when a program begins, a line when it is done."""
    prepare(seeds[0])
    lock = threading.Lock()

    def say(**what: Any) -> None:
        with lock:
            print(json.dumps(what), flush=True)

    def one(seed: int) -> None:
        say(seed=seed)
        found = check(seed, fault if seed % 3 == 1 else "", callers=min(threads, 2))
        say(seed=seed, found=found)

    with ThreadPoolExecutor(threads) as crowd:
        list(crowd.map(one, seeds))


def child(seeds: list[int], threads: int, fault: str) -> tuple[list[Any], Any, str]:
    """What a child process said, how it ended, and its last words."""
    command = [sys.executable, "-m", "tests.fuzz_kernels", "--serve", *map(str, seeds)]
    command += ["--threads", str(threads), "--fault", fault]
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        limit = 60 + 5 * len(seeds)
        try:
            ran = subprocess.run(command, cwd=ROOT, stdout=out, stderr=err, timeout=limit)
            end = ran.returncode
        except subprocess.TimeoutExpired:
            end = f"no end within {limit} s"
        out.seek(0)
        err.seek(0)
        words = err.read().splitlines()
        fatal = [line for line in words if any(word in line for word in FATAL)]
        return [json.loads(line) for line in out], end, "\n".join((fatal or words)[-5:])


def explore(seeds: list[int], threads: int, fault: str) -> Iterator[tuple[list[int], Any]]:
    """Seeds, and what became of them."""
    while seeds:
        said, end, words = child(seeds, threads, fault)
        if end and not said:
            raise RuntimeError(f"fuzz_kernels: a child ended with {end}: {words}")
        done = {each["seed"]: each["found"] for each in said if "found" in each}
        yield from (([seed], found) for seed, found in done.items())
        lost = [each["seed"] for each in said if each["seed"] not in done]
        if end:
            kind = "error" if isinstance(end, str) else "abort"
            yield lost, {"kind": kind, "text": f"{end}: {words}"}
        seeds = [seed for seed in seeds if seed not in done and seed not in lost]


def run(programs: int, seed: int, threads: int = 1, fault: str = "") -> Counter[str]:
    """How many programs went how; what is found is printed."""
    counts, start, end = Counter(), time.perf_counter(), seed + programs
    for k, first in enumerate(range(seed, end, BATCH)):
        several = threads if k % THREADED == 1 else 1
        for seeds, found in explore([*range(first, min(first + BATCH, end))], several, fault):
            counts["programs"] += len(seeds)
            counts["kernels"] += found.get("kernel", False)
            counts[found["kind"]] += 1
            if found["kind"]:
                print(f"seed {seeds}: {found['kind']}: {found['text']}", flush=True)
    counts["seconds"] = round(time.perf_counter() - start)
    return counts


def table(counts: Counter[str]) -> str:
    share = f"{counts['kernels'] / max(counts['programs'], 1):.0%}"
    row = {"jaxlib": metadata.version("jaxlib"), "programs": counts["programs"]}
    row |= {name: counts[kind] for kind, name in BAD.items()}
    row |= {"undecided": counts["undecided"], "with a kernel": share}
    row |= {"seconds": counts["seconds"]}
    wide = {name: max(len(name), len(str(x))) for name, x in row.items()}
    lines = (row.keys(), row.values())
    return "\n".join(
        "  ".join(str(x).rjust(n) for x, n in zip(line, wide.values(), strict=True))
        for line in lines
    )


def show(seed: int) -> dict[str, Any]:
    """One program, printed and run in this process."""
    prepare(seed)
    program = Program(seed)
    args, named = program.arguments()
    print(eqx.filter_make_jaxpr(program)(*args, **named)[0], flush=True)
    return check(seed)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz_kernels")
    parser.add_argument("--programs", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0, help="of the first program")
    parser.add_argument("--threads", type=int, default=4, help=f"in one of {THREADED} batches")
    parser.add_argument("--only", type=int, metavar="SEED", help="print one program, run it")
    parser.add_argument("--serve", type=int, nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--fault", default="", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve:
        serve(args.serve, args.threads, args.fault)
        return 0
    if args.only is not None:
        found = show(args.only)
        print(found)
        return int(found["kind"] in BAD)
    counts = run(args.programs, args.seed, args.threads, args.fault)
    print(table(counts))
    return int(any(counts[kind] for kind in BAD) or counts["kernels"] < ENOUGH * args.programs)


if __name__ == "__main__":
    sys.exit(main())
