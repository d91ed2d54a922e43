"""Bodies that bounce: where their energy goes, impacts, slopes through them, restarts."""

import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import fem, material, mesh, sdf
from sorojax.units import mm

HEIGHT = 11 * mm  # of the centre
OUTSIDE = sdf.Circle([0.0, HEIGHT], 10 * mm)
RING = mesh.triangulate(OUTSIDE - sdf.Circle([0.0, HEIGHT], 7 * mm), size=4 * mm, order=2)
FLOOR = sdf.HalfPlane([0.0, 0.0], [0.0, 1.0])
AWAY = RING.points - jnp.array([[0.0, HEIGHT]])


def ring(friction=0.5, young_modulus=1e6) -> fem.Problem:
    """A ring 1 mm above a floor, on which it may bounce and roll."""
    rubber = material.neo_hookean(
        young_modulus=young_modulus, poisson_ratio=0.4, density=1000.0
    )
    touch = fem.Contact(mesh.facets_on(RING, OUTSIDE), FLOOR, friction=friction, name="floor")
    return fem.problem(
        RING, rubber, kinematics=fem.PlaneStrain(1.0), supports=(),
        loads=(fem.Gravity(), touch), formulation=fem.Displacement(), free=True,
    )  # fmt: skip


def bounce(problem, duration=0.04, step=2.5e-4, speed=(0.3, -0.5), spin=-40.0, **options):
    """The motion of a ring that is thrown at the floor, turning."""
    turn = jnp.stack([-AWAY[:, 1], AWAY[:, 0]], axis=1)
    start = jnp.zeros_like(AWAY), jnp.asarray(speed)[None] + spin * turn
    return fem.simulate(problem, duration, step, start=start, **options)


def total(motion: fem.Motion) -> np.ndarray:
    """Energy of the body, its weight and its contact [J]."""
    e = motion.energies
    return np.asarray(e.kinetic + e.elastic + e.loads)


def pressure(states) -> np.ndarray:
    """Of the points on the floor [Pa]."""
    floor = states.memory[-1]
    assert isinstance(floor, fem.Contact) and floor.grip is not None
    return np.asarray(floor.grip.pressure)


@eqx.filter_jit
def _rubbing(floor, problem, old, new):
    """Work of friction in a step of `GeneralisedAlpha(1.0)` [J]."""
    force = floor.state(problem, (old + new) / 2).friction
    way = floor.points_of(problem, new) - floor.points_of(problem, old)
    return jnp.sum(force * way.reshape(force.shape))


def rubbed(motion: fem.Motion) -> float:
    """Work of friction [J], of the forces on the ways of its points in every step."""
    floors, u, work = motion.states.memory[-1], motion.displacements, 0.0
    for k in range(1, len(motion)):
        floor = jax.tree.map(lambda x, k=k: x[k] if eqx.is_inexact_array(x) else x, floors)
        work += float(_rubbing(floor, motion.problem, u[k - 1], u[k]))
    return work


def unexplained(friction: float, viscosity: float, step: float) -> float:
    """Energy that neither damping nor friction has taken from a ring, over that it had."""
    method = fem.GeneralisedAlpha(1.0)  # that damps nothing
    damping = fem.KelvinVoigt(viscosity)
    motion = bounce(ring(friction), step=step, method=method, damping=damping)
    energy, taken = total(motion), float(motion.energies.dissipated[-1]) - rubbed(motion)
    assert np.diff(energy).max() < 1e-3 * energy[0]
    pressed = pressure(motion.states).max(axis=(1, 2))
    assert pressed.max() > 0 == pressed[-1]  # it has left the floor
    assert (taken > 0.1 * energy[0]) == (viscosity > 0)
    return (energy[0] - energy[-1] - taken) / energy[0]


def test_a_bouncing_ring_loses_energy_to_damping_and_friction_alone():
    """A contact that steps do not resolve loses a little more, and less in shorter ones."""
    bare, damped, rubs = (unexplained(*x, 2.5e-4) for x in ((1e-9, 0), (1e-9, 20), (0.5, 20)))
    for share in (bare, damped, rubs):
        assert 0 < share < 0.04
    assert unexplained(1e-9, 0.0, 1.25e-4) < 0.9 * bare


def _way(theta):
    """Way of the centre [m] after an impact, by speeds, friction and modulus."""
    speed, fall, friction, young = theta
    problem = ring(friction, young)
    motion = bounce(
        problem, 6e-3, 2.5e-4, jnp.stack([speed, -fall]), save=2,
        newton=fem.Newton(residual_tolerance=1e-12),
    )  # fmt: skip
    return jnp.mean(motion.displacements[-1, :, 0])


@pytest.mark.stress(44)
def test_slopes_go_through_an_impact_with_friction():
    theta = jnp.array([0.3, 0.5, 0.3, 1e6])
    slope = jax.grad(_way)(theta)
    for k in range(4):
        d = jnp.zeros(4).at[k].set(1e-6 * theta[k])
        change = (_way(theta + d) - _way(theta - d)) / (2 * d[k])
        np.testing.assert_allclose(slope[k], change, rtol=1e-3)


SCRIPT = """
import sys, tests.conftest
from tests.test_fem_contact_motion import go_on
go_on(*sys.argv[1:])
"""


def go_on(begin: str, end: str) -> None:
    """The second half of a motion in a process of its own, from file to file."""
    like = bounce(ring(), 1 / 4096, 1 / 4096).end
    start = eqx.tree_deserialise_leaves(begin, like)
    motion = fem.simulate(ring(), 16 / 4096, 1 / 4096, start=start)
    eqx.tree_serialise_leaves(end, motion.end)


def test_a_run_that_goes_on_in_a_new_process_is_the_whole_run_to_the_last_bit(tmp_path):
    half, whole = (bounce(ring(), n / 4096, 1 / 4096) for n in (16, 32))
    assert pressure(half.end).max() > 0  # in contact, with friction
    begin, end = tmp_path / "half.eqx", tmp_path / "whole.eqx"
    eqx.tree_serialise_leaves(begin, half.end)
    subprocess.run(
        [sys.executable, "-c", SCRIPT, str(begin), str(end)],
        cwd=Path(__file__).parent.parent, check=True,
    )  # fmt: skip
    again = eqx.tree_deserialise_leaves(end, whole.end)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(whole.end), strict=True):
        assert np.array_equal(a, b)
