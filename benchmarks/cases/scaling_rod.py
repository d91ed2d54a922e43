"""Acceleration of rods over modes, quadrature nodes and segments, in compiled loops."""

import jax.numpy as jnp

from benchmarks import scaling
from benchmarks.cases.rod_assembly import CALLS, loop
from benchmarks.fingers import LENGTH, finger
from benchmarks.harness import quick
from sorojax.math.lie import SE3
from sorojax.rod import chebyshev, circle, num_dof, rest, rod, serial
from sorojax.units import MPa, mm

MODES, NODES, SEGMENTS = (2, 4, 8, 16, 32), (8, 16, 32, 64, 128), (1, 2, 4, 8)


def slender(modes: int, nodes: int):
    """The finger D1 with so many modes of each of its two curvatures."""
    return rod(
        SE3(),
        chebyshev(kappa_y=modes, kappa_z=modes),
        circle(6 * mm),
        length=LENGTH,
        young_modulus=1 * MPa,
        poisson_ratio=0.3,
        density=2000.0,
        nodes=nodes,
    )


def point(size, model):
    v = 20.0 * jnp.sin(jnp.arange(1.0, num_dof(model) + 1))
    return scaling.program(size, loop, model, rest(model), v, calls=CALLS)


def rows():
    few = slice(1, -1, 2) if quick("every second size, and the largest") else slice(None)
    # nodes grow with modes: rows of Jacobians times their columns squared
    yield from scaling.rows(
        "modes", "modes", 3.0, (point(m, slender(m, m + 5)) for m in MODES[few])
    )
    # the matrix that integrates from node to node is full
    yield from scaling.rows(
        "nodes, three modes", "nodes", 2.0, (point(n, slender(3, n)) for n in NODES[few])
    )
    unit = finger(8)
    yield from scaling.rows(
        "segments", "segments", 3.0, (point(k, serial(*[unit] * k)) for k in SEGMENTS[few])
    )
