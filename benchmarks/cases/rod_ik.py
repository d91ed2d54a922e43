"""Latency of inverse kinematics: ten steps to a tip pose, six coordinates, p50 and p99."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.fingers import LENGTH, finger, random_states
from benchmarks.harness import Row
from sorojax.rod import Pose, inverse_kinematics, tip_pose

CALLS, TARGETS, ITERATIONS = 5000, 20, 10
BARS = {50: 80e-6, 99: 1e-3}
REFERENCE = "worst tip of 20 drawn poses, each from rest, over length"


def rows():
    qs, _ = random_states(TARGETS)
    rest = jnp.zeros(qs.shape[1])
    for nodes, null_space in ((6, True), (8, True), (8, False)):
        rod = finger(nodes)
        options = {"forces": ()} if null_space else {}

        def solve(pose, q, rod=rod, options=options):
            return inverse_kinematics(rod, Pose(pose), q, iterations=ITERATIONS, **options).q

        poses = jnp.stack([jnp.asarray(tip_pose(rod, jnp.array(q))) for q in qs])
        start = time.perf_counter()
        call = jax.jit(solve)
        jax.block_until_ready(call(poses[0], rest))
        first = time.perf_counter() - start
        ends = [jnp.asarray(tip_pose(rod, call(pose, rest))) for pose in poses]
        two = jax.block_until_ready([poses[0], poses[1]])
        errors = [float(jnp.linalg.norm(d[:3, 3])) / LENGTH for d in jnp.stack(ends) - poses]
        seconds = []
        for index in range(CALLS):
            pose = two[index % 2]
            start = time.perf_counter()
            jax.block_until_ready(call(pose, rest))
            seconds.append(time.perf_counter() - start)
        for percent, bar in BARS.items():
            yield Row(
                "sorojax", {"nodes": nodes, "null_space": null_space, "percentile": percent},
                compile_s=first, run_s=float(np.percentile(seconds, percent)),
                run_s_min=min(seconds), run_s_max=max(seconds), error=max(errors),
                reference=REFERENCE, bar=bar,
            )  # fmt: skip
