"""Accelerations of the finger D1 in batches, and of its planar twin, in compiled loops.

1024 states by `vmap`, and by `forward_dynamics`, which takes them in chunks that stay in
the cache; and 1024 rods of different radius by `batched`. The planar finger bends in one
plane: three coordinates, no exponential of a group; by `jax.jit`, and by `sorojax.jit`.
"""

import functools
import time

import jax
import jax.numpy as jnp

from benchmarks.cases.rod_acceleration import CALLS, loop
from benchmarks.fingers import LENGTH, MODES, accelerate, finger, random_states
from benchmarks.harness import Row, Timing, measure, measure_together
from sorojax import jit
from sorojax.math.compiled import batched
from sorojax.math.lie import SE2, SE3
from sorojax.rod import Gravity, chebyshev, circle, forward_dynamics, operators, rod
from sorojax.units import MPa, mm

WORKERS = 1  # nothing here calls the host
STATES = 1024
ITEM_BAR = 3.5e-6  # s of a state in a batch
PLANAR_BAR = 0.45  # share of the spatial acceleration


def planar_finger():
    return rod(
        SE2(),
        chebyshev(kappa_z=MODES),
        circle(6 * mm),
        length=LENGTH,
        young_modulus=1 * MPa,
        poisson_ratio=0.3,
        density=2000.0,
        nodes=8,
    )


def fingers(radii):
    """Fingers of these radii [m], stacked."""

    def one(radius):
        return rod(
            SE3(),
            chebyshev(kappa_y=MODES, kappa_z=MODES),
            circle(radius),
            length=LENGTH,
            young_modulus=1 * MPa,
            poisson_ratio=0.3,
            density=2000.0,
            nodes=8,
        )

    return jax.vmap(one)(radii)


def together(rod, q, v):
    constants = operators(rod)
    return jax.vmap(lambda q, v: accelerate(rod, constants, q, v))(q, v)


def by_door(rod, q, v):
    return forward_dynamics(rod, q, v, (Gravity(),))


def many_rods(rods, q, v):
    one = batched(lambda rod, q, v: forward_dynamics(rod, q, v, (Gravity(),)))
    return one(rods, q, v)


def in_turns(programs, repeats: int) -> dict[str, Timing]:
    """Of programs that compile at their first call, as `measure_together`."""
    runs = {name: [] for name in programs}
    for _ in range(repeats + 1):
        for name, program in programs.items():
            start = time.perf_counter()
            jax.block_until_ready(program())
            runs[name].append(time.perf_counter() - start)
    return {
        name: Timing(max(0.0, first - sorted(rest)[repeats // 2]), tuple(rest))
        for name, (first, *rest) in runs.items()
    }


def compared(timings: dict[str, Timing], by: str):
    times = {name: timing.per(CALLS).columns() for name, timing in timings.items()}
    yield Row("sorojax", {"dof": 6, "states": 1, "by": by}, **times["spatial"])
    yield Row(
        "sorojax",
        {"dof": 3, "states": 1, "by": by},
        **times["planar"],
        bar=PLANAR_BAR * times["spatial"]["run_s"],
    )


def rows():
    q, v = (jnp.asarray(x) for x in random_states(STATES))
    spatial, planar = finger(8), planar_finger()
    alone = measure_together(
        {
            "spatial": lambda both: loop(both[0], q[0], v[0]),
            "planar": lambda both: loop(both[1], q[0, :MODES], v[0, :MODES]),
        },
        (spatial, planar),
        repeats=15,
    )
    yield from compared(alone, "jax.jit")
    programs = {
        "spatial": functools.partial(jit(loop), spatial, q[0], v[0]),
        "planar": functools.partial(jit(loop), planar, q[0, :MODES], v[0, :MODES]),
    }
    yield from compared(in_turns(programs, repeats=15), "sorojax.jit")
    batches = {"vmap": together, "forward_dynamics": by_door}
    for name, timing in measure_together(batches, spatial, q, v, repeats=60).items():
        yield Row(
            "sorojax",
            {"dof": 6, "states": STATES, "by": name},
            **timing.per(STATES).columns(),
            bar=ITEM_BAR,
        )
    rods = fingers(jnp.linspace(4 * mm, 8 * mm, STATES))
    yield Row(
        "sorojax",
        {"dof": 6, "rods": STATES, "by": "batched"},
        **measure(many_rods, rods, q, v, repeats=60).per(STATES).columns(),
    )
