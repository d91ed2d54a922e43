"""Acceleration of rods over modes, quadrature nodes and segments, in compiled loops."""

import jax.numpy as jnp

from benchmarks import scaling
from benchmarks.cases.rod_assembly import CALLS, loop
from benchmarks.fingers import finger
from benchmarks.harness import quick
from sorojax.rod import num_dof, rest, serial

MODES, NODES, SEGMENTS = (2, 4, 8, 16, 32), (8, 16, 32, 64, 128), (1, 2, 4, 8)


def point(size, model):
    v = 20.0 * jnp.sin(jnp.arange(1.0, num_dof(model) + 1))
    return scaling.program(size, loop, model, rest(model), v, calls=CALLS)


def rows():
    few = slice(1, -1, 2) if quick("every second size, and the largest") else slice(None)
    # nodes grow with modes: rows of Jacobians times their columns squared
    yield from scaling.rows(
        "modes", "modes", 3.0, (point(m, finger(m + 5, m)) for m in MODES[few])
    )
    # the matrix that integrates from node to node is full
    yield from scaling.rows(
        "nodes, three modes", "nodes", 2.0, (point(n, finger(n)) for n in NODES[few])
    )
    unit = finger(8)
    yield from scaling.rows(
        "segments", "segments", 3.0, (point(k, serial(*[unit] * k)) for k in SEGMENTS[few])
    )
