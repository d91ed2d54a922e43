"""Latency of the shape of a frame: three modes, four markers, and the filter beside it."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, quick
from sorojax import compiled, enable_low_latency
from sorojax.math.lie import SE2
from sorojax.rod import (
    Damping,
    Gravity,
    PointWrench,
    chebyshev,
    circle,
    equilibrium,
    forward_kinematics,
    rod,
    tip_pose,
)
from sorojax.systems import (
    Markers,
    ShapeFilter,
    estimate_shape,
    start_filter,
    update_filter,
)

#: The slowest of them is the last column.
CALLS = 20_000 if quick("the slowest of 100,000 calls; here it is of 20,000") else 100_000
BARS = {50: 100e-6, 99: 1e-3}
S = np.array([0.25, 0.5, 0.75, 1.0])
REFERENCE = "worst tip, 31 unknown contacts on a rod of six modes, 0.2 mm noise [m]"


def _finger(modes: int, nodes: int):
    return rod(
        SE2(),
        chebyshev(kappa_z=modes),
        circle(6e-3),
        length=0.08,
        young_modulus=1e6,
        poisson_ratio=0.3,
        density=1100.0,
        nodes=nodes,
    )


def rows():
    enable_low_latency()  # as a loop in real time would
    true, known = _finger(6, 10), _finger(3, 8)
    random = np.random.default_rng(0)
    frames, tips = [], []
    for force in np.linspace(-0.15, 0.15, 31):
        q = equilibrium(true, (PointWrench([0.0, 0.0, float(force)], s=0.55),)).q
        poses = forward_kinematics(true, q, S)
        frames.append(poses[:, :2, 2] + 2e-4 * random.standard_normal((4, 2)))
        tips.append(poses[-1, :2, 2])
    markers = Markers(known, S)
    rest = jnp.zeros(3)

    shape = jax.jit(lambda places, q: estimate_shape(markers, places, q).q)
    q, worst = rest, 0.0
    start = time.perf_counter()
    jax.block_until_ready(shape(frames[0], rest))
    first = time.perf_counter() - start
    for places, tip in zip(frames, tips, strict=True):
        q = shape(places, q)
        worst = max(worst, float(jnp.linalg.norm(tip_pose(known, q)[:2, 2] - tip)))
    yield from _latency("shape of a frame", lambda k: shape(frames[k % 31], q), first, worst)

    estimator = ShapeFilter(markers, 1 / 60)
    loads = (Damping(0.01), Gravity([0.0, -9.81]))
    begin = start_filter(estimator)
    start = time.perf_counter()
    filtered = compiled(
        lambda last, seen: update_filter(estimator, last, seen, forces=loads), begin, frames[0]
    )
    jax.block_until_ready(filtered(begin, frames[0]).q)
    first = time.perf_counter() - start
    yield from _latency("filter", lambda k: filtered(begin, frames[k % 31]).q, first, None)


def _latency(what: str, call, first: float, error: float | None):
    seconds = []
    for k in range(CALLS):
        start = time.perf_counter()
        jax.block_until_ready(call(k))
        seconds.append(time.perf_counter() - start)
    for percent, bar in BARS.items():
        yield Row(
            "sorojax",
            {"what": what, "modes": 3, "markers": 4, "percentile": percent, "calls": CALLS},
            first,
            float(np.percentile(seconds, percent)),
            min(seconds),
            max(seconds),
            error=error,
            reference=REFERENCE if error is not None else None,
            bar=bar,
        )
    if error is not None:
        yield Row(
            "sorojax",
            {"what": "tip error"},
            error=error,
            bar=1e-3,
            bar_on="error",
            reference=REFERENCE,
        )
