"""Friction of FEM bodies: threshold, memory, forces and derivatives; no overlap."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import Status, contact, fem, material, mesh, sdf
from sorojax.contact.friction import Grip, no_grip
from sorojax.fem.contact.obstacle import moving
from sorojax.fem.dynamics.step import StepState
from sorojax.units import mm

FRICTION, WEIGHT, LENGTH, DEPTH = 0.5, 981.0, 20 * mm, 0.03  # [-], N/m^3, m, m
FLOOR = sdf.HalfPlane([0.0, 0.0], [0.0, 1.0])
LAW = contact.SpringSlider(contact.Coulomb(FRICTION), 1e8, 1e-3)
HAIRS = contact.DirectionalCoulomb(0.2, 0.8, [2.0, 0.0])
ONE_WAY = contact.SpringSlider(HAIRS, 1e8, 1e-3)


def block(pull=(0.0, 0.0), stiffness=None, friction=FRICTION) -> fem.Problem:
    """A block under a dead pressure on a floor, held by soft springs on its top."""
    shape = mesh.rectangle([0, 0], [LENGTH, 5 * mm], divisions=(4, 1), element=mesh.Quad4())
    top = shape.node_sets["top"]
    return fem.problem(
        shape,
        material.neo_hookean(young_modulus=1e6, poisson_ratio=0.3, density=1000.0),
        kinematics=fem.PlaneStrain(DEPTH),
        supports=(),
        loads=(
            fem.Traction(shape.facet_sets["top"], (0.0, -1e3), name="weight"),
            fem.Foundation(top, jnp.array([10.0, 1e-6]), jnp.asarray(pull), name="pull"),
            fem.Contact(
                shape.facet_sets["bottom"], FLOOR, stiffness, name="floor", friction=friction
            ),
        ),
        formulation=fem.Displacement(),
    )


NORMAL = 1e3 * LENGTH * DEPTH  # N
LIMIT = FRICTION * NORMAL / 50.0  # m, by which five springs of 10 N/m slip


@pytest.mark.parametrize("law", [LAW, ONE_WAY], ids=["Coulomb", "directional"])
def test_the_step_of_friction_has_a_potential_and_a_memory(law):
    key = jax.random.key(0)
    normal = jnp.array([0.6, 0.8])
    anchor, back, position = 1e-5 * jax.random.normal(key, (3, 40, 2))
    grip = Grip(
        anchor,
        jnp.linspace(0, 4e3, 40),
        jnp.broadcast_to(normal, (40, 2)),
        jnp.linspace(1e8, 0, 40),
        back,
    )
    traction = law.traction(grip, position)
    slope = jax.grad(lambda x: jnp.sum(law.energy(grip, x)))(position)
    assert jnp.allclose(traction, -slope, rtol=1e-12, atol=1e-12)
    assert jnp.max(jnp.abs(traction @ normal)) < 1e-9
    middle = law.law.middle(grip.pressure, grip.normal)
    pull = -traction if middle is None else -traction - middle
    size, limit = jnp.linalg.norm(pull, axis=1), law.law.limit(grip.pressure)
    assert jnp.all(size <= limit * (1 + 1e-12))
    assert 5 < jnp.sum(size < 0.999 * limit) < 35  # some hold, some slide
    assert jnp.array_equal(law.loading(grip, position) > 1, size >= limit * (1 - 1e-9))
    # spring and dashpot together carry the traction; a point that rests keeps its anchor
    spring = law.stretch(grip, position)
    before = back - anchor
    before = before - (before @ normal)[:, None] * normal[None]
    together = 1e8 * spring + grip.drag[:, None] * (spring - before)
    assert jnp.allclose(together, -traction, rtol=1e-9, atol=1e-9)
    rest = Grip(anchor, jnp.full(40, 1e9), grip.normal, 0 * grip.drag, back)
    moved = position - anchor
    assert jnp.allclose(
        law.stretch(rest, position), moved - (moved @ normal)[:, None] * normal[None]
    )
    # what forces at a later half of the step do on its way, springs have lost, or more
    pressure = jnp.linspace(0, 4e3, 40)
    held = grip._replace(anchor=back - law.bounded(before, pressure, grip.normal))
    for share in (0.5, 0.8, 1.0):
        way = (position - back) / share
        rise = law.stored(law.stretch(held, position, share)) - law.stored(back - held.anchor)
        lost = -jnp.sum(law.traction(held, position) * way, axis=1) - rise
        assert jnp.min(lost) > -1e-12 * jnp.max(lost)
    curvature = jax.hessian(lambda x: jnp.sum(law.energy(no_grip(x), x)))(position[0])
    assert jnp.all(curvature == 0)  # nothing of a point that does not touch, NaN neither


def pulled(problem, ways, start=None):
    """Displacements of a row of equilibria, and the problem after the last."""
    u, states = start, []
    for way in ways:
        problem = fem.with_load(problem, "pull", jnp.array([1.0, 0.0]) * way)
        u = fem.solve(problem, start=u).displacement
        states.append((problem, u))
        problem = fem.update_friction(problem, u)
    return states, problem


def test_a_block_holds_below_the_threshold_and_slides_above():
    states, problem = pulled(block(), [0.0, 0.9 * LIMIT] + 7 * [0.9975 * LIMIT])
    pressed, u = states[-1]
    stuck = float(u[:, 0].mean())
    assert 0 < stuck < 2e-3 * LIMIT  # the springs of friction and the shear of the block
    found = fem.contact_state(pressed, u, "floor")
    assert jnp.allclose(found.total[1], NORMAL, rtol=1e-6)
    want = -50.0 * (0.9975 * LIMIT - u[np.asarray(pressed.loads[1].nodes), 0].mean())
    assert jnp.allclose(jnp.sum(found.friction[:, 0]), want, rtol=1e-6)
    about = jnp.array([0.3, 0.0])
    turned = found.torque() - 0.3 * found.total[1]
    assert jnp.allclose(found.torque(about), turned, rtol=1e-9)
    assert jnp.allclose(found.power(jnp.array([2.0, 0.0])), 2 * want, rtol=1e-6)
    # points that shared their load out do not creep
    more, problem = pulled(problem, [0.9975 * LIMIT] * 3, u)
    assert jnp.max(jnp.abs(more[-1][1] - u)) < 1e-14
    # beyond the threshold it slides until the springs are as short as friction allows
    states, _ = pulled(problem, [1.0025 * LIMIT, 3 * LIMIT, 3 * LIMIT], u)
    assert float(states[0][1][:, 0].mean()) > stuck
    slid, u = states[-1]
    assert jnp.allclose(u[np.asarray(slid.loads[1].nodes), 0].mean(), 2 * LIMIT, rtol=5e-3)
    force = fem.contact_state(slid, u, "floor").friction[:, 0]
    assert jnp.allclose(jnp.sum(force), -FRICTION * NORMAL, rtol=1e-3)


def test_bristles_hold_more_one_way_than_back():
    for way, coefficient in ((2.0, 0.2), (-2.0, 0.8)):
        states, _ = pulled(block(friction=HAIRS), [0.0, way * LIMIT, way * LIMIT])
        slid, u = states[-1]
        force = fem.contact_state(slid, u, "floor").friction[:, 0]
        want = -np.sign(way) * coefficient * NORMAL
        assert jnp.allclose(jnp.sum(force), want, rtol=1e-3)
    # in space: the coefficients along the direction, the root of their product sideways, and
    # half the pull loads a point half as much
    law = contact.SpringSlider(contact.DirectionalCoulomb(0.2, 0.8, [1.0, 0.0, 0.0]), 1e6)
    grip = no_grip(jnp.zeros(3))._replace(
        pressure=jnp.asarray(10.0), normal=jnp.array([0.0, 0.0, 1.0])
    )
    for way, most in (([1.0, 0, 0], 2.0), ([-1.0, 0, 0], 8.0), ([0, 1.0, 0], 4.0)):
        way = jnp.asarray(way)
        far = law.traction(grip, way)
        assert jnp.linalg.norm(far) <= 8.0 and far @ way < 0
        for share in (0.5, 1 - 1e-9, 1 + 1e-9):
            at = share * most / 1e6 * way
            assert jnp.allclose(law.loading(grip, at), share, rtol=1e-12)
            pulled_back = law.traction(grip, at)
            assert jnp.allclose(pulled_back, -jnp.minimum(share, 1.0) * most * way, atol=1e-6)


def test_a_moving_obstacle_takes_the_block_along():
    states, problem = pulled(block(), [0.0])
    u = states[-1][1]
    for way in (0.5 * LIMIT, 3 * LIMIT):
        problem = fem.with_load(problem, "floor", jnp.array([1.0, 0.0]) * way)
        u = fem.solve(problem, start=u).displacement
        top = float(u[np.asarray(problem.loads[1].nodes), 0].mean())
        assert abs(top / min(way, LIMIT) - 1) < 0.01
        problem = fem.update_friction(problem, u)


def test_friction_carries_gradients_through_its_memory():
    base = block()
    places = {
        "friction": lambda p: p.loads[2].friction.coefficient,
        "stiffness": lambda p: p.loads[2].stiffness,
        "spring": lambda p: p.loads[1].stiffness,
    }
    tight = fem.Newton(residual_tolerance=1e-13, step_tolerance=1e-9)

    def end(scales):
        """Where the block is after it was pulled out and half way back."""
        problem = base
        for name, where in places.items():
            problem = eqx.tree_at(where, problem, where(base) * scales[name])
        u = None
        for way in (0.0, 2 * LIMIT, 2 * LIMIT, 0.8 * LIMIT):
            problem = fem.with_load(problem, "pull", jnp.array([1.0, 0.0]) * way)
            u = fem.solve(problem, start=u, newton=tight).displacement
            problem = fem.update_friction(problem, u)
        return 1e3 * jnp.mean(u[:, 0])

    ones = dict.fromkeys(places, jnp.array(1.0))
    slopes = jax.grad(end)(ones)
    for name, slope in slopes.items():
        ends = [end(ones | {name: jnp.array(1.0 + h)}) for h in (1e-4, -1e-4)]
        assert jnp.allclose(slope, (ends[0] - ends[1]) / 2e-4, rtol=1e-6, atol=1e-9), name
    assert abs(slopes["friction"]) > 0.1 * FRICTION * NORMAL / 50.0 * 1e3


def test_offsets_bound_the_overlap_whatever_the_stiffness():
    found = []
    for stiffness in (1e7, 4e7):
        soft = block(stiffness=stiffness, friction=None)
        solution = fem.solve_contact(soft, penetration=1e-7)
        assert fem.overlap(solution.problem, solution.displacement) <= 1e-7
        assert fem.overlap(soft, fem.solve(soft).displacement) > 2e-5
        state = fem.contact_state(solution.problem, solution.displacement, "floor")
        assert jnp.allclose(state.total[1], NORMAL, rtol=1e-6)
        found.append(solution.displacement)
    assert jnp.max(jnp.abs(found[0] - found[1])) < 1e-7
    with pytest.raises(fem.ConvergenceError, match="max_updates"):
        fem.solve_contact(soft, penetration=1e-15, max_updates=1)
    left = fem.solve_contact(soft, penetration=1e-15, max_updates=0, throw=False)
    assert bool(left.status == Status.not_converged)


@pytest.mark.parametrize("name", ["friction", "friction_velocity", "friction_stiffness"])
def test_bad_friction_is_refused(name):
    problem = block()
    what = "Coulomb: `coefficient`" if name == "friction" else name
    with pytest.raises(ValueError, match=f"{what}.*must be positive"):
        floor = dataclasses.replace(problem.loads[2], grip=None, **{name: -1.0})
        floor.check("Contact 'floor'", problem.mesh, problem.kinematics)


def test_a_direction_of_friction_has_the_axes_of_the_mesh():
    with pytest.raises(ValueError, match="direction of friction"):
        block(friction=contact.DirectionalCoulomb(0.2, 0.8, [1.0, 0.0, 0.0]))


def free_block() -> fem.Problem:
    """A block that lies on a floor and is held by nothing else."""
    shape = mesh.rectangle([0, 0], [LENGTH, 5 * mm], divisions=(4, 1), element=mesh.Quad4())
    return fem.problem(
        shape,
        material.neo_hookean(young_modulus=1e6, poisson_ratio=0.3, density=1000.0),
        kinematics=fem.PlaneStrain(DEPTH),
        supports=(),
        loads=(
            fem.Gravity([0.0, -9.81]),
            fem.Contact(shape.facet_sets["bottom"], FLOOR, friction=FRICTION, name="floor"),
        ),
        formulation=fem.Displacement(),
        free=True,
    )


@eqx.filter_jit
def _begun(problem, u) -> fem.Contact:
    """The contact of a block in a step from displacement `u`."""
    one, floor = jnp.ones(()), problem.loads[1]
    step = StepState(u, u, u, one, u, one, one, jnp.array(2 / 3))
    return moving(floor, problem.mesh, floor.value).begun(problem, step)


def test_a_step_knows_how_far_points_may_move_before_they_touch():
    problem, rest = free_block(), jnp.zeros((10, 2))
    tilted = rest.at[:, 1].set(3 * mm + 0.1 * problem.mesh.points[:, 0])
    above = _begun(problem, tilted)
    gaps = jnp.min(above.points_of(problem, tilted)[..., 1], axis=1)
    assert above.start is not None
    assert jnp.all((above.start.clear > 0) & (above.start.clear <= gaps * (1 + 1e-12)))
    room = above.room(problem)
    assert 0 < room <= 2 / 3 * jnp.min(gaps)
    # no force within, one a little beyond what the nearest point has
    for share, acts in ((0.999, False), (1.6, True)):
        lower = tilted.at[:, 1].add(-share * (2 / 3 * jnp.min(gaps) if acts else room))
        force = jax.grad(above.potential, argnums=1)(problem, lower)
        assert bool(jnp.any(force != 0)) == acts
    down = _begun(problem, rest.at[:, 1].set(-1e-5))
    assert down.start is not None
    assert jnp.all(down.start.clear == 0) and down.room(problem) <= 0


@pytest.mark.stress(43)
def test_on_a_slope_a_block_sticks_without_creep_or_slides_as_coulomb_says():
    def tilted(share):
        """It settles on the flat, then the floor leans up to a share of the threshold."""
        angle = share * np.arctan(FRICTION)

        def gravity(t):
            now = angle * jnp.clip((t - 0.04) / 0.06, 0.0, 1.0)
            return 9.81 * jnp.stack([jnp.sin(now), -jnp.cos(now)])

        return fem.simulate(free_block(), 0.2, 2e-3, save=5, gravity=gravity)

    held = tilted(0.9975)
    turns = fem.contact_switching(held, 0.05)
    assert bool(turns.near[-1]) and not bool(turns.switched[-1])
    assert 0 < float(turns.slip[-1]) < 0.05 and float(turns.gap[-1]) > 0
    speed = np.abs(np.asarray(held.velocities)[-1]).max()
    assert speed < 1e-4 * float(held.problem.loads[1].friction_velocity)
    slid = np.asarray(held.displacements)[:, :, 0].mean(axis=1)
    assert 0 < slid[-1] < 3e-5  # the springs of friction and the shear of the block
    free = tilted(1.05)
    assert bool(jnp.any(fem.contact_switching(free).switched[1:]))
    velocity = np.asarray(free.velocities)[:, :, 0].mean(axis=1)
    steep = 1.05 * np.arctan(FRICTION)
    slope = 9.81 * (np.sin(steep) - FRICTION * np.cos(steep))
    assert np.isclose(velocity[-1] - velocity[-2], slope * 0.05, rtol=0.01)


@pytest.mark.stress(41)
def test_a_block_that_starts_half_inside_is_let_out_and_never_gains_energy():
    problem = free_block()
    u = np.zeros(problem.mesh.points.shape)
    u[:, 1] = -2.5 * mm
    motion = fem.simulate(problem, 0.1, 2e-3, start=(u, 0 * u), save=11)
    speed = np.asarray(motion.velocities)[:, :, 1].mean(axis=1)
    assert np.abs(speed).max() < 2 * np.sqrt(2 * 9.81 * 2.5 * mm)
    assert float(motion.displacements[-1, :, 1].mean()) > -0.1 * mm
    thrown = np.tile([0.1, -0.5], (len(u), 1))
    motion = fem.simulate(problem, 0.02, 2e-4, start=(0 * u, thrown), save=11)
    energies = motion.energies
    total = np.asarray(energies.kinetic + energies.elastic + energies.loads)
    assert np.all(np.diff(total) < 1e-3 * total[0])
    assert float(total[-1]) < 0.95 * total[0]
