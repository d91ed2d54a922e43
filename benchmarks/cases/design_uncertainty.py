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

    def cost(x):
        film = run(x, first)
        return jnp.mean((film["body.tip_angle"] - film["target.value"]) ** 2)

    count = 100 if quick("fewer samples") else SAMPLES
    samples = np.random.default_rng(0).multivariate_normal(
        np.asarray(mean), np.asarray(covariance), count
    )
    seen = np.array([float(cost(jnp.asarray(x))) for x in samples])
    found = design.propagate_covariance(cost, mean, covariance=covariance)
    yield Row(
        "sorojax",
        {
            "method": "first order",
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
