"""Acceleration of segments end to end, 6 dof each, per call in a compiled loop."""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.fingers import MODES, finger
from benchmarks.harness import Row, measure
from sorojax.rod import (
    Free,
    Gravity,
    Part,
    acceleration,
    assembly,
    num_coordinates,
    num_dof,
    operators,
    rest,
    serial,
)

CALLS = 200
REFERENCE = "growth over the row before: order of the cost in the number of coordinates"


def loop(model, q, v):
    """A chain of calls; the coordinates of a free base stay."""
    constants, count = operators(model), num_dof(model)
    ahead = num_coordinates(model) - count

    def body(_, state):
        q, v = state
        a = acceleration(model, constants, jnp.zeros((), q.dtype), q, v, (Gravity(),))
        return q.at[ahead:].add(1e-12 * v), v + 1e-9 * a

    return jax.lax.fori_loop(0, CALLS, body, (q, v))


def rows():
    draw, before = np.random.default_rng(0), None
    unit = finger(8)
    floating = assembly(unit.group, rod=Part(unit, Free()))
    for name, model in (
        ("one rod", unit),
        ("floating rod", floating),
        *((f"{k} segments", serial(*[unit] * k)) for k in (1, 2, 5, 10)),
    ):
        count = num_dof(model)
        v = jnp.array(draw.normal(0, 20, count))
        timing = measure(loop, model, rest(model), v, repeats=5).per(CALLS)
        now = min(timing.runs)
        growth = None
        if before is not None and "segments" in name and count > before[0]:
            growth = float(np.log(now / before[1]) / np.log(count / before[0]))
        before = (count, now)
        settings = {"model": name, "dof": count, "modes": MODES}
        yield Row("sorojax", settings, **timing.columns(), error=growth, reference=REFERENCE)
