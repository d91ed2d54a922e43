"""What print tolerances and the fit of the rubber do to the cost of a closed loop, from one
gradient, against samples of the whole chain from the drawing to the loop.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from benchmarks import loops
from benchmarks.harness import Row, quick
from sorojax import design, material
from sorojax.units import mm

BAR, SAMPLES, TOLERANCE = 0.1, 1000, 0.1 * mm
DIMENSIONS = ("wall_thickness", "bellow_width", "gap", "base", "chamber_height", "roof")


def chain():
    """From uncertain numbers to the angles of the tip and of the target [rad]; their means and
    covariance."""
    robot = loops.bellows(2.5 * mm, 0.4, states=5, num_bellows=2)
    actuator, _, valve, pid = robot.numbers
    points = material.presets.DRAGON_SKIN_30_POINTS
    fit = material.fit_tensile(*points, poisson_ratio=0.49, density=1080.0)
    sizes = jnp.stack([getattr(actuator, name) for name in DIMENSIONS])
    law = fit.material
    fitted = ("c1", "c2", "c3")[: len(fit.covariance)]
    constants = jnp.stack([getattr(law, name) for name in fitted])
    drawn = actuator.body(), actuator.layer()
    options = {"modes": {"kappa_z": 2}, "step": 2e-3, "before": drawn}

    def run(x, near=None):
        count = len(DIMENSIONS)
        named = dict(zip(DIMENSIONS, x[:count], strict=True))
        rubber = dict(zip(fitted, x[count:], strict=True))
        printed = dataclasses.replace(actuator, **named)
        mixed = dataclasses.replace(law, **rubber)
        return robot.run(printed, mixed, valve, pid, near=near, **options)

    blocks = TOLERANCE**2 * np.eye(len(DIMENSIONS)), np.asarray(fit.covariance)
    return run, jnp.concatenate([sizes, constants]), block_diag(*blocks)


def rows():
    run, mean, covariance = chain()
    first = run(mean)
    held = first["body.tip_angle"]

    def costs(x):
        """Off its least: the target of the loop; at its least: the motion of the mean."""
        film = run(x, first)
        angle = film["body.tip_angle"]
        return jnp.stack([jnp.mean((angle - y) ** 2) for y in (film["target.value"], held)])

    count = 100 if quick("fewer samples") else SAMPLES
    samples = np.random.default_rng(0).multivariate_normal(mean, covariance, count)
    sampled = np.array([np.asarray(costs(jnp.asarray(x))) for x in samples])
    for k, name in enumerate(("off the optimum", "at the optimum")):
        found = design.propagate_covariance(
            lambda x, k=k: costs(x)[k], mean, covariance=covariance, order=k + 1
        )
        seen = sampled[:, k]
        yield Row(
            "sorojax",
            {
                "method": f"{name}, order {k + 1}",
                "deviation": float(found.deviation),
                "sampled": float(seen.std(ddof=1)),
                "mean": float(found.mean),
                "mean of samples": float(seen.mean()),
                "samples": count,
            },
            reference=f"{count} samples of the chain",
            error=abs(float(found.deviation) / float(seen.std(ddof=1)) - 1),
            bar=BAR,
            bar_on="error",
        )
