"""What three Maxwell branches cost a step of `rod.rollout`, on rods of six coordinates.

Times are CPU seconds on one core, the least of runs in turn.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, quick
from sorojax import SE2, SE3, material, rod
from sorojax.units import mm

THREE = material.Prony([0.1, 0.08, 0.05], [0.01, 0.1, 1.0])
BASES = {
    "planar": (SE2(), rod.chebyshev(kappa_z=4, sigma_x=2)),
    "spatial": (SE3(), rod.chebyshev(kappa_x=1, kappa_y=2, kappa_z=2, sigma_x=1)),
}
STEPS, BAR = 20_000, 0.15


def rows():
    for name, (group, basis) in BASES.items():
        finger = rod.rod(
            group,
            basis,
            rod.circle(5 * mm),
            length=100 * mm,
            young_modulus=1e6,
            poisson_ratio=0.45,
            density=1000,
        )
        forces = {0: (rod.Gravity(),), 3: (rod.Gravity(), rod.Relaxation(THREE))}
        for listed in forces.values():
            _time(finger, listed)
        best = dict.fromkeys(forces, np.inf)
        for _ in range(3 if quick("seven runs in turn") else 7):
            for count, listed in forces.items():
                best[count] = min(best[count], _time(finger, listed))
        for count, took in best.items():
            settings = {"rod": name, "branches": count, "us_per_step": round(1e6 * took, 2)}
            share = took / best[0] - 1
            bar = {"error": share, "bar": BAR, "bar_on": "error"} if count else {}
            yield Row("sorojax", settings, run_s=took, reference="without branches", **bar)


def _time(finger: rod.Rod, forces) -> float:
    """CPU time of a step [s]."""
    rest = jnp.zeros(finger.basis.num_dof)
    start = time.process_time()
    path = rod.rollout(finger, rest, rest, forces, step=1e-3, saves=20, every=STEPS // 20)
    jax.block_until_ready(path.q)
    return (time.process_time() - start) / STEPS
