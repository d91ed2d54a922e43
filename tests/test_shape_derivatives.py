"""Derivatives of measures by every number of a shape, against differences of the measure."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from sorojax import mesh as M, robots, sdf


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


def test_every_number_of_a_shape_moves_the_area_of_its_mesh():
    """And that of its chamber: the nodes follow, the cells stay."""
    hole = sdf.rotate(sdf.Rectangle([-0.3, -0.2], [0.35, 0.25]), 0.3, center=[0.02, 0.01])
    shape = sdf.Rectangle([-1.0, -0.8], [1.1, 0.9]) - hole - sdf.Circle([0.7, 0.5], 0.15)
    mesh = M.chambers(M.triangulate(shape, size=0.3)).mesh
    holes = [np.asarray(mesh.facet_sets[f"chamber_{i}"]) for i in (0, 1)]
    numbers, rest = eqx.partition(shape, eqx.is_inexact_array)
    flat, unravel = ravel_pytree(numbers)

    def measures(p):
        moved = M.move(mesh, eqx.combine(unravel(p), rest))
        x = jnp.mean(moved.points[moved.cells], axis=1)
        areas = M.cell_areas(moved)
        inner = [M.enclosed_volume(moved, facets) for facets in holes]
        return jnp.stack([jnp.sum(areas), *inner, jnp.sum(areas * x[:, 0] ** 2)])

    both = jax.jit(lambda p: (measures(p), jax.jacrev(measures)(p)))
    exact, step = np.asarray(both(flat)[1]), 1e-6
    ends = [
        [np.asarray(both(flat + s * way)[0]) for s in (1, -1)]
        for way in step * np.eye(len(flat))
    ]
    central = np.stack([(a - b) / (2 * step) for a, b in ends], axis=1)
    free = np.asarray(flat) != 0  # fillets of no radius are at their bound
    assert np.abs(central).max(axis=0).min() > 1e-5  # every number moves something
    assert free.sum() == len(flat) - 2 and np.abs(exact - central)[:, free].max() < 1e-6


ROBOTS = {
    "air": lambda robot: sdf.volume(robot.chambers(), 8),
    "body": lambda robot: sdf.inertia_tensor(robot.body(), 1e9, 8)[2, 2],
}


@pytest.mark.parametrize("name", ROBOTS)
def test_the_air_and_the_inertia_of_a_robot_follow_all_its_numbers(name):
    numbers, rest = eqx.partition(robots.BendingActuator(num_bellows=1), eqx.is_inexact_array)
    flat, unravel = ravel_pytree(numbers)
    build = eqx.filter_jit(lambda p: eqx.combine(unravel(p), rest))

    def at(p):
        return ROBOTS[name](build(p))

    way = flat * np.cos(1 + np.arange(len(flat)))
    value, slope = (np.asarray(a) for a in jax.jvp(at, (flat,), (way,)))
    step = 1e-7
    difference = (float(at(flat + step * way)) - float(at(flat - step * way))) / (2 * step)
    assert abs(slope - difference) < 1e-6 * max(abs(difference), 0.1 * abs(value))
