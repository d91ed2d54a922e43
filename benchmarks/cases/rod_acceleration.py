"""Acceleration of the soft finger D1 at random states, per call in a loop compiled by
`jax.jit`, and by `sorojax.jit`, which makes one kernel of it."""

import jax
import numpy as np

from benchmarks import peers
from benchmarks.fingers import MODES, accelerate, finger, random_states
from benchmarks.harness import Row, measure, measure_calls, quick
from sorojax import jit
from sorojax.rod import operators

CALLS, STATES = 1000, 4
BAR = 7e-6  # s per call
REFERENCE = "the same at 32 nodes, largest relative difference"


def at(rod, q, v):
    """Accelerations of all states [1/(m s^2)]."""
    constants = operators(rod)
    every = jax.vmap(lambda q, v: accelerate(rod, constants, q, v))
    return np.asarray(jax.jit(every)(q, v))


def loop(rod, q, v):
    """A chain of calls that the compiler can neither fold nor reorder."""
    constants = operators(rod)

    def body(_, state):
        q, v = state
        return q + 1e-9 * v, v + 1e-9 * accelerate(rod, constants, q, v)

    return jax.lax.fori_loop(0, CALLS, body, (q, v))


def rows():
    q, v = random_states(STATES)
    reference = at(finger(32), q, v)

    def error(arrays):
        size = np.linalg.norm(reference, axis=1)
        return float(np.max(np.linalg.norm(arrays["a"] - reference, axis=1) / size))

    for nodes in (8,) if quick("6, 10 and 12 nodes") else (6, 8, 10, 12):
        rod, alone = finger(nodes), jit(loop)
        timings = {
            "jax.jit": measure(loop, rod, q[0], v[0]),
            "sorojax.jit": measure_calls(lambda: alone(rod, q[0], v[0]), repeats=9),  # noqa: B023
        }
        off = error({"a": at(rod, q, v)})
        for by, timing in timings.items():
            yield Row(
                "sorojax",
                {"nodes": nodes, "by": by},
                **timing.per(CALLS).columns(),
                error=off,
                reference=REFERENCE,
                bar=BAR if nodes == 8 else None,
            )
    for nodes in (8,) if quick("soromox with 12 nodes") else (8, 12):
        yield peers.row(
            "soromox",
            "acceleration",
            {"q": q, "v": v},
            error,
            REFERENCE,
            nodes=nodes,
            modes=MODES,
            calls=CALLS,
            repeats=5,
        )
