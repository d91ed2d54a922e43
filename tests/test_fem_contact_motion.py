"""Bodies that bounce: where their energy goes, impacts, slopes through them, restarts."""

import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import Status, fem, material, mesh, sdf
from sorojax.units import mm

pytestmark = pytest.mark.quick

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
        RING,
        rubber,
        kinematics=fem.PlaneStrain(1.0),
        supports=(),
        loads=(fem.Gravity(), touch),
        formulation=fem.Displacement(),
        free=True,
    )


def bounce(problem, duration=0.04, step=2.5e-4, speed=(0.3, -0.5), spin=-40.0, **options):
    """The motion of a ring that is thrown at the floor, turning."""
    turn = jnp.stack([-AWAY[:, 1], AWAY[:, 0]], axis=1)
    start = jnp.zeros_like(AWAY), jnp.asarray(speed)[None] + spin * turn
    return fem.simulate(problem, duration, step, start=start, **options)


def total(motion: fem.Trajectory) -> np.ndarray:
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


def rubbed(motion: fem.Trajectory) -> float:
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
    """But for the error in time of the elastic forces, of order two."""
    bare, damped, rubs = (unexplained(*x, 2.5e-4) for x in ((1e-9, 0), (1e-9, 20), (0.5, 20)))
    for share in (bare, damped, rubs):
        assert abs(share) < 0.005
    assert abs(unexplained(1e-9, 0.0, 1.25e-4)) < 0.3 * abs(bare)


def test_a_conserving_method_keeps_the_energy_of_a_bouncing_ring():
    motion = bounce(ring(1e-9), method=fem.EnergyMomentum())
    energy = total(motion)
    assert np.abs(energy / energy[0] - 1).max() < 1e-6
    assert float(motion.energies.loads.max()) > 0.01 * energy[0]  # it was in contact


def share_of_the_impulse(motion: fem.Trajectory) -> float:
    """Of what the floor gave along it, over what it gave across."""
    linear = np.asarray(fem.momentum(motion)[0])
    along, across = linear[-1] - linear[0]
    across += 9.81 * float(fem.total_mass(motion.problem) * motion.time[-1])
    return -along / across


@pytest.mark.parametrize("rho_inf", [0.5, 0.7, 1.0])
def test_friction_gives_its_share_of_an_impulse_that_steps_do_not_resolve(rho_inf):
    """The ring touches for seven of them."""
    method = fem.GeneralisedAlpha(rho_inf)
    motion = bounce(ring(0.1), 0.02, 1e-3, (1.0, -0.5), 0.0, method=method)
    assert 5 <= np.sum(pressure(motion.states).max(axis=(1, 2)) > 0) <= 9
    np.testing.assert_allclose(share_of_the_impulse(motion), 0.1, rtol=1e-5)


@pytest.mark.parametrize(
    ("rho_inf", "speed", "rtol"), [(1.0, (2.0, -2.0), 1e-4), (0.8, (1.0, -0.5), 3e-3)]
)
def test_friction_gives_its_share_of_an_impulse_in_steps_that_are_cut(rho_inf, speed, rtol):
    """Between 1/2 and 1 the acceleration of the method hands a part of a force on to the next
    step, of another size."""
    method = fem.GeneralisedAlpha(rho_inf)
    motion = bounce(ring(0.1), 0.02, 1e-3, speed, 0.0, method=method)
    assert motion.stats.cuts > 0
    np.testing.assert_allclose(share_of_the_impulse(motion), 0.1, rtol=rtol)


@pytest.mark.stress(95)
@pytest.mark.parametrize("friction", [0.1, 0.3, 0.8])
@pytest.mark.parametrize("rho_inf", [0.5, 1.0])
@pytest.mark.parametrize(
    ("speed", "spin"), [((1.0, -0.5), 0.0), ((2.0, -2.0), 0.0), ((0.3, -0.5), -40.0)]
)
def test_an_impact_with_friction_that_steps_do_not_resolve_gains_no_energy(
    friction, rho_inf, speed, spin
):
    method = fem.GeneralisedAlpha(rho_inf)
    motion = bounce(ring(friction), 0.02, 1e-3, speed, spin, method=method)
    assert pressure(motion.states).max() > 0 and risen(motion) < 1e-3


def test_a_floor_that_moves_may_give_energy_by_friction():
    """And steps are not cut for that: a plate that lies on it goes along with it."""
    problem = plate(FLOOR, 1e6, None, 0.5, fem.Gravity())

    def floor(t):
        return jnp.stack([jnp.clip(t - 0.02, 0.0, None) * 0.2, 0.0 * t])

    motion = fem.simulate(problem, 0.1, 1e-3, wall=floor)
    assert motion.stats.cuts < 5
    assert abs(float(motion.velocities[-1, :, 0].mean()) / 0.2 - 1) < 0.05


def plate(obstacle, young_modulus, stiffness=None, friction=None, *loads) -> fem.Problem:
    """A plate of 20 x 5 mm and an obstacle below its underside."""
    shape = mesh.rectangle([0, 0], [20 * mm, 5 * mm], divisions=(4, 1), element=mesh.Quad4())
    rubber = material.neo_hookean(
        young_modulus=young_modulus, poisson_ratio=0.3, density=1000.0
    )
    under = shape.facet_sets["bottom"]
    touch = fem.Contact(under, obstacle, stiffness, name="wall", friction=friction)
    return fem.problem(
        shape,
        rubber,
        kinematics=fem.PlaneStrain(0.03),
        supports=(),
        loads=(*loads, touch),
        formulation=fem.Displacement(),
        free=True,
    )


def shot(problem, duration, step, height=10 * mm, **options) -> fem.Trajectory:
    """Down at 100 m/s."""
    rest = jnp.zeros_like(problem.mesh.points)
    start = rest.at[:, 1].set(height), rest.at[:, 1].set(-100.0)
    return fem.simulate(problem, duration, step, start=start, **options)


WALL = sdf.Rectangle([-0.1, -1 * mm], [0.1, 0.0])


def risen(motion: fem.Trajectory) -> float:
    """Share of its energy that a body was given by nobody."""
    energy = total(motion)
    assert np.all(np.isfinite(energy))
    return float((energy / energy[0]).max() - 1)


@pytest.mark.stress(40)
def test_at_a_hundred_metres_per_second_nothing_gets_through_a_wall_of_a_millimetre():
    """In steps of a quarter of a millisecond, 25 mm of its way."""
    motion = shot(plate(WALL, 1e9), 5e-4, 2.5e-4)
    assert motion.stats.cuts > 0 and risen(motion) < 1e-3
    assert float(motion.velocities[-1, :, 1].mean()) > 50.0  # it has bounced
    # a contact far too soft to hold it stops the run instead
    soft = shot(plate(WALL, 1e9, 1e10), 5e-4, 2.5e-4, throw=False)
    assert bool(soft.status == Status.not_converged) and risen(soft) < 1e-3
    assert float((soft.problem.mesh.points + soft.end.displacement)[:, 1].min()) > -1 * mm


@pytest.mark.stress(40)
def test_rubber_survives_a_hundred_metres_per_second():
    """Three times the speed of its waves."""
    motion = shot(plate(FLOOR, 1e6), 5e-4, 2.5e-4)
    assert risen(motion) < 1e-3 and float(motion.velocities[-1, :, 1].mean()) > 10.0


@pytest.mark.stress(40)
def test_sixteen_steps_in_the_period_of_a_contact_keep_its_energy():
    stiffness = 5.0 * 1e4**2  # of a plate of 5 kg/m^2, for 1592 Hz
    problem = plate(FLOOR, 1e10, stiffness)
    step = 2 * np.pi / 1e4 / 16
    method = fem.GeneralisedAlpha(1.0)
    motion = shot(problem, 20 * step, step, 1 * mm, method=method)
    energy = total(motion)
    assert float(motion.velocities[-1, :, 1].mean()) > 99.0  # it has bounced
    assert abs(energy[-1] / energy[0] - 1) < 1e-6


def _way(theta):
    """Way of the centre [m] after an impact, by speeds, friction and modulus."""
    speed, fall, friction, young = theta
    problem = ring(friction, young)
    motion = bounce(
        problem,
        6e-3,
        2.5e-4,
        jnp.stack([speed, -fall]),
        save=2,
        newton=fem.Newton(residual_tolerance=1e-12),
    )
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
        cwd=Path(__file__).parent.parent,
        check=True,
    )
    again = eqx.tree_deserialise_leaves(end, whole.end)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(whole.end), strict=True):
        assert np.array_equal(a, b)
