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

    build = eqx.filter_jit(lambda p: eqx.combine(unravel(p), rest))

    def at(p):
        return measure(build(p))

    lower, upper = (np.asarray(corner) for corner in make().bounding_box())
    value, slope = (np.asarray(a) for a in jax.value_and_grad(at)(flat))
    size, flat = (upper - lower).max(), np.asarray(flat)
    step = 3e-9 * size  # short: nodes where two walls are as near have kinks
    for k, found in enumerate(slope):
        way = np.eye(len(flat))[k] * step
        difference = (float(at(flat + way)) - float(at(flat - way))) / (2 * step)
        assert abs(found - difference) < 1e-6 * max(abs(difference), abs(value) / size), k
