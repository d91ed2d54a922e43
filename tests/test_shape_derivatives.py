"""Derivatives of measures by every number of a shape, against differences of the measure."""

import equinox as eqx
import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from sorojax import robots, sdf


def blended():
    ball, other = sdf.Sphere([0.0, 0.1, 0.0], 0.5), sdf.Sphere([0.6, 0.0, 0.03], 0.4)
    return sdf.SmoothUnion(ball, other, 0.2)


CASES = {
    "body": (lambda: robots.BellowsActuator().body(), sdf.area),
    "air": (lambda: robots.BellowsActuator().chambers(), sdf.area),
    "blend": (blended, lambda shape: sdf.inertia_tensor(shape, 1.0, 12)[2, 2]),
}


@pytest.mark.parametrize("name", CASES)
def test_every_number_of_a_shape_moves_its_measure(name):
    make, measure = CASES[name]
    numbers, rest = eqx.partition(make(), eqx.is_inexact_array)
    flat, unravel = ravel_pytree(numbers)

    def at(p):
        return measure(eqx.combine(unravel(p), rest))

    lower, upper = (np.asarray(corner) for corner in make().bounding_box())
    size, value, slope = (upper - lower).max(), float(at(flat)), np.asarray(jax.grad(at)(flat))
    step = 3e-9 * size  # short: nodes where two walls are as near have kinks
    for k, found in enumerate(slope):
        ends = [float(at(flat.at[k].add(e * step))) for e in (-2, -1, 1, 2)]
        difference = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)
        assert abs(found - difference) < 1e-6 * max(abs(difference), abs(value) / size), k
