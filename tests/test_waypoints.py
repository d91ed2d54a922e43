"""Waypoints, a controller as a force, and weight beside the line of a rod."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import fem, material, mesh as M, reduction, rod as R, systems
from sorojax.math.lie import SE2


def test_waypoints_are_joined_by_straight_lines_and_jumps():
    path = systems.Waypoints(
        [0.0, 1.0, 2.0, 2.0, 4.0], [[0, 0], [1, 2], [1, 2], [5, 5], [7, 5]]
    )
    times = jnp.array([-1.0, 0.0, 0.25, 1.5, 2.0, 3.0, 9.0])
    want = [[0, 0], [0, 0], [0.25, 0.5], [1, 2], [5, 5], [6, 5], [7, 5]]
    np.testing.assert_allclose(jax.vmap(path)(times), want, atol=1e-15)
    before = path(jnp.asarray(2.0 - 1e-9))
    np.testing.assert_allclose(before, [1, 2], atol=1e-12)
    rate = jax.jacfwd(path)
    np.testing.assert_allclose(rate(jnp.asarray(3.0)), [1, 0], atol=1e-15)
    assert np.all(np.isfinite(np.asarray(rate(jnp.asarray(2.0)))))
    with pytest.raises(ValueError, match="Sort the waypoints"):
        systems.Waypoints([1.0, 0.0], [0.0, 1.0])


def test_a_controller_as_a_force_holds_a_rod_where_it_should_be():
    rod = R.rod(
        SE2(),
        R.chebyshev(kappa_z=2),
        R.circle(5e-3),
        length=0.1,
        young_modulus=1e6,
        poisson_ratio=0.4,
        density=1100.0,
        nodes=6,
    )
    goal = jnp.array([6.0, -2.0])
    law = systems.ComputedTorque(rod, (R.Gravity(),), systems.Constant(goal), 400.0, 40.0)
    forces = (R.Gravity(), systems.ControlForce(law))
    path = R.rollout(rod, jnp.zeros(2), jnp.zeros(2), forces, step=2e-3, saves=250)
    np.testing.assert_allclose(path.q[-1], goal, rtol=2e-3)
    # e'' + 40 e' + 400 e = 0 from rest
    t = np.asarray(path.time)[:, None]
    want = np.asarray(goal) * (1 - (1 + 20 * t) * np.exp(-20 * t))
    np.testing.assert_allclose(path.q, want, atol=5e-3 * 6)


def test_weight_beside_the_line_is_that_of_the_solid():
    """A stiff solid beam under its weight: forces on the line and moments about it."""
    length, height = 0.1, 0.02
    cells = M.rectangle([0.0, 0.0], [length, height], divisions=(10, 2), element=M.Quad8())
    rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.4, density=1000.0)
    problem = fem.problem(
        cells,
        rubber,
        kinematics=fem.PlaneStrain(0.01),
        supports=(fem.Fixed(M.named(cells, "left")),),
    )
    line = reduction.Line([0.0, 0.002], [length, 0.002])
    weight = reduction.offset_weight(problem, line, [9.81, -1.0])
    mass = 1000.0 * length * height * 0.01
    assert float(weight.mass) == pytest.approx(mass)
    assert float(weight.arm) == pytest.approx(0.008)
    rod = R.rod(
        SE2(),
        R.constant("kappa_z", "sigma_x"),
        R.rectangle(0.01, height),
        length=length,
        young_modulus=1e6,
        poisson_ratio=0.4,
        density=1000.0,
    )
    force = weight(jnp.zeros(()), R.motion(rod, jnp.zeros(2)))
    # per curvature the section at s turns by s L and moves by (s L)^2 / 2, per stretch by s L
    stretch = mass * 9.81 * length / 2
    bend = -mass * 1.0 * length**2 / 6 - mass * 9.81 * 0.008 * length / 2
    np.testing.assert_allclose(force, [bend, stretch], rtol=1e-3)
