"""Latency of inverse kinematics: ten steps to a tip pose, six coordinates, p50 and p99.

Compiled once by `sorojax.compiled`, as a loop in real time would; beside it by `jax.jit`.
"""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.fingers import LENGTH, finger, random_states
from benchmarks.harness import Row, quick
from sorojax import compiled, enable_low_latency
from sorojax.rod import Pose, inverse_kinematics, tip_pose

TARGETS, ITERATIONS = 20, 10
CALLS = {"compiled": 100_000, "jax.jit": 5000}  # the slowest of them is the last column
KINDS = ((8, True), (6, True), (8, False))  # nodes, with the null space
BARS = {50: 80e-6, 99: 1e-3}
REFERENCE = "worst tip of 20 drawn poses, each from rest, over length"


def rows():
    enable_low_latency()  # as a loop in real time would
    few = quick("6 nodes, and steps without the null space")
    for nodes, null_space in KINDS[:1] if few else KINDS:
        for by in ("compiled",) if quick("jax.jit") else CALLS:
            yield from latency(nodes, null_space, by)


def latency(nodes: int, null_space: bool, by: str):
    qs, _ = random_states(TARGETS)
    rest = jnp.zeros(qs.shape[1])
    rod = finger(nodes)
    options: Any = {"forces": ()} if null_space else {}

    def solve(pose, q):
        return inverse_kinematics(rod, Pose(pose), q, iterations=ITERATIONS, **options).q

    poses = jnp.stack([jnp.asarray(tip_pose(rod, jnp.array(q))) for q in qs])
    two = jax.block_until_ready([poses[0], poses[1]])
    start = time.perf_counter()
    call = compiled(solve, two[0], rest) if by == "compiled" else jax.jit(solve)
    jax.block_until_ready(call(two[0], rest))
    first = time.perf_counter() - start
    ends = [jnp.asarray(tip_pose(rod, call(pose, rest))) for pose in poses]
    errors = [float(jnp.linalg.norm(d[:3, 3])) / LENGTH for d in jnp.stack(ends) - poses]
    seconds = []
    for index in range(CALLS[by]):
        pose = two[index % 2]
        start = time.perf_counter()
        jax.block_until_ready(call(pose, rest))
        seconds.append(time.perf_counter() - start)
    for percent, bar in BARS.items():
        yield Row(
            "sorojax",
            {
                "nodes": nodes,
                "null_space": null_space,
                "by": by,
                "percentile": percent,
                "calls": CALLS[by],
            },
            compile_s=first,
            run_s=float(np.percentile(seconds, percent)),
            run_s_min=min(seconds),
            run_s_max=max(seconds),
            error=max(errors),
            reference=REFERENCE,
            bar=bar if by == "compiled" else None,
        )
