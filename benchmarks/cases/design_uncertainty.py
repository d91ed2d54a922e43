"""What print tolerances and the fit of the rubber do to the costs of a closed loop, from one
gradient and from second derivatives, against samples of the whole chain from the drawing to
the loop.
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
    designed = first["body.tip_angle"]

    def tracking(film):
        """Off its optimum: the slope counts."""
        return jnp.mean((film["body.tip_angle"] - film["target.value"]) ** 2)

    def departure(film):
        """From the motion of the design itself, where the slope vanishes: curvature counts."""
        return jnp.mean((film["body.tip_angle"] - designed) ** 2)

    costs = {"tracking": (tracking, 1), "departure": (departure, 2)}
    count = 100 if quick("fewer samples") else SAMPLES
    samples = np.random.default_rng(0).multivariate_normal(
        np.asarray(mean), np.asarray(covariance), count
    )
    films = (run(jnp.asarray(x), first) for x in samples)
    seen = np.array([[float(cost(film)) for cost, _ in costs.values()] for film in films])
    for (name, (cost, order)), column in zip(costs.items(), seen.T, strict=True):
        found = design.propagate_covariance(
            lambda x, cost=cost: cost(run(x, first)), mean, covariance=covariance, order=order
        )
        sampled = float(column.std(ddof=1))
        yield Row(
            "sorojax",
            {
                "cost": name,
                "order": order,
                "deviation": float(found.deviation),
                "sampled": sampled,
                "mean": float(found.mean),
                "mean of samples": float(column.mean()),
                "samples": count,
            },
            reference=f"{count} samples of the chain",
            error=abs(float(found.deviation) / sampled - 1),
            bar=BAR,
            bar_on="error",
        )
