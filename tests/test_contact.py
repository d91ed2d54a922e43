"""Contact: the law, the broad phase, a block on a plane and a cylinder on a flat."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sorojax as sj
from benchmarks.cases import fem_contact
from sorojax import contact, fem, material, mesh, sdf
from sorojax.contact.broadphase import clearance, far as contact_far
from sorojax.contact.facet import contacts, gaps as contact_gaps
from sorojax.contact.friction import no_grip
from sorojax.contact.swept import passes
from sorojax.units import mm

LAW = contact.Penalty(2e7, 1e-5)
FLOOR = sdf.HalfPlane([0.0, 0.0], [0.0, 1.0])


@pytest.mark.versions
def test_the_law_is_twice_differentiable_and_its_inverse_agrees():
    gap = jnp.linspace(-3e-5, 1e-5, 401)
    pressure = -jax.vmap(jax.grad(LAW.energy))(gap)
    assert jnp.allclose(pressure, LAW.pressure(gap), rtol=1e-12, atol=1e-12)
    curvature = jax.vmap(jax.grad(jax.grad(LAW.energy)))(gap)
    assert jnp.max(jnp.abs(jnp.diff(curvature))) < 1.01 * 2e7 * 1e-7 / 1e-5
    assert jnp.all(pressure[gap > 0] == 0) and curvature[0] == 2e7
    levels = jnp.array([1.0, 90.0, 110.0, 1e3])
    assert jnp.allclose(LAW.pressure(-LAW.penetration(levels)), levels, rtol=1e-12)


def test_the_mean_pressure_of_a_step_takes_what_the_energy_gives(getkey):
    before, after = 3e-5 * jax.random.uniform(getkey(), (2, 200), minval=-1.0)
    after = after.at[:3].set(before[:3])  # points at rest
    mean = LAW.mean_pressure(before, after)
    given = LAW.energy(before) - LAW.energy(after)
    assert jnp.allclose(mean * (after - before), given, rtol=1e-13, atol=1e-15)
    assert jnp.allclose(mean[:3], LAW.pressure(before[:3]), rtol=1e-12)
    # the energy of a step is one of its slope, of which the other gap knows too
    slope = jax.vmap(jax.grad(LAW.energy_of_step, argnums=1))
    assert jnp.allclose(slope(before, after), -mean, rtol=1e-12, atol=1e-12)
    curved = jax.vmap(jax.hessian(LAW.energy_of_step, argnums=(1, 0)))(before, after)[0]
    for k, gaps in enumerate(((0 * before, 1e-9), (1e-9, 0 * after))):
        ends = [slope(before + sign * gaps[0], after + sign * gaps[1]) for sign in (1, -1)]
        assert jnp.allclose(curved[k], (ends[0] - ends[1]) / 2e-9, atol=1e-6 * 2e7)
    assert jnp.all(curved[0] >= 0)  # so that a step has one solution


def test_points_that_go_through_a_wall_are_seen():
    wall = sdf.Rectangle([0.0, -1.0], [1 * mm, 1.0])
    ways = (  # from, to, along the wall [mm], seen
        (-10.0, 15.0, 3.0, True), (-10.0, 0.9, 0.0, True), (-10.0, 0.4, 5.0, False),
        (-1.0, 1.2, 0.0, True), (0.1, 0.3, 9.0, False), (0.4, 0.7, 0.0, True),
        (0.3, 1.5, 0.0, True), (0.9, 1.5, 0.0, False), (0.2, -9.0, 0.0, False),
        (-1.0, -0.5, 30.0, False), (-1.0, -1.0, 0.0, False),
    )  # fmt: skip
    x, to, sway, seen = (jnp.array(column) for column in zip(*ways, strict=True))
    before = jnp.stack([x, 0 * x], axis=1) * mm
    after = jnp.stack([to, sway], axis=1) * mm
    assert jnp.array_equal(passes(wall, before, after), seen)
    assert not jnp.any(passes(wall, before - 1.0, after - 1.0))
    hole = sdf.HalfPlane([0.0, 0.0], [1.0, 0.0]) | sdf.HalfPlane([1 * mm, 0.0], [-1.0, 0.0])
    assert not jnp.any(passes(hole, before[:7], after[:7]) & (x[:7] > -0.5))


@pytest.mark.versions
def test_forces_are_slopes_of_the_energy_and_balance():
    ball = sdf.Sphere([0.0, 0.0, 0.0], 0.01)
    points = jnp.array([[0.0099, 0, 0], [0.0, 0.007, 0.007], [0.0, 0.0, 0.02]])
    areas, shift = jnp.array([1e-6, 2e-6, 3e-6]), jnp.array([0.0, 1e-5, 0.0])

    def energy(points, shift):
        return jnp.sum(areas * LAW.energy(contact_gaps(ball, points, shift)))

    found = contacts(LAW, ball, points, areas, shift)
    slope, on_ball = jax.grad(energy, argnums=(0, 1))(points, shift)
    assert jnp.allclose(found.force, -slope, rtol=1e-12, atol=1e-18)
    assert jnp.allclose(found.total, on_ball, rtol=1e-12, atol=1e-18)
    assert found.active.tolist() == [True, True, False]


def test_what_is_far_is_never_inside(getkey):
    ball = sdf.Sphere([0.0, 0.0, 0.0], 0.01)
    clouds = 0.03 * jax.random.normal(getkey(), (200, 1, 3)) + 0.004 * jax.random.normal(
        getkey(), (200, 5, 3)
    )
    skipped = jax.vmap(lambda cloud: contact_far(ball, cloud))(clouds)
    assert 0 < jnp.sum(skipped) < 200
    assert jnp.all(jnp.min(ball(clouds), axis=1)[skipped] > 0)
    # nor if it moves by less than what it has room for
    room = jax.vmap(lambda cloud: clearance(ball, cloud, jnp.array(1e-3)))(clouds)
    way = jax.random.normal(getkey(), clouds.shape)
    way = 0.999 * room[:, None, None] * way / jnp.linalg.norm(way, axis=2, keepdims=True)
    assert jnp.any(room > 0)
    assert jnp.all(jnp.min(ball(clouds + way), axis=1)[room > 0] > 1e-3)
    # as large as one value can tell: from the middle of the points, less the farthest of them
    corners = jnp.array([[0.02, 0.03, 0.0], [0.04, 0.05, 0.0]])
    want = jnp.hypot(0.03, 0.04) - 0.01 - 0.01 * jnp.sqrt(2.0)
    assert jnp.allclose(clearance(ball, corners), want, rtol=1e-12)
    near = clearance(ball, corners, jnp.array(1e-3))
    assert jnp.allclose(near, want - 1e-3, rtol=1e-12)


def _block(stiffness=None):
    """A block that is pressed on a plane by its own weight and a load on top."""
    block = mesh.rectangle([0, 0], [20 * mm, 10 * mm], divisions=(4, 2), element=mesh.Quad4())
    return fem.problem(
        block,
        material.neo_hookean(young_modulus=1e5, poisson_ratio=0.0, density=1000.0),
        kinematics=fem.PlaneStrain(0.03),
        supports=(fem.Fixed(block.node_sets["left"], components=(0,)),),
        loads=(
            fem.Traction(block.facet_sets["top"], jnp.array([0.0, -2e3]), name="weight"),
            fem.Contact(block.facet_sets["bottom"], FLOOR, stiffness, name="floor"),
            fem.Foundation(block.node_sets["top"], jnp.array([0.0, 1e-6]), name="soft"),
        ),
        formulation=fem.Displacement(),
    )


def test_a_block_on_a_plane_sinks_in_as_the_stiffness_says():
    problem = _block()
    solution = fem.solve(problem)
    floor, pressed = problem.loads[1], 2e3 * 20 * mm * 0.03
    state = fem.contact_state(problem, solution.displacement, "floor")
    held = 1e-6 * jnp.sum(solution.displacement[problem.loads[2].nodes, 1])
    assert jnp.allclose(state.total[1] - held, pressed, rtol=1e-8)
    assert jnp.abs(state.total[0]) < 1e-8 * pressed
    assert jnp.allclose(floor.stiffness, 10 * 1e5 / (5 * mm), rtol=1e-6)
    assert jnp.allclose(-state.gap, floor.law.penetration(jnp.array(2e3)), rtol=1e-7)
    assert bool(jnp.all(state.active))


@pytest.mark.versions
def test_contact_carries_gradients_of_obstacle_and_stiffness():
    base = _block(2e7)
    places = {
        "obstacle": lambda p: p.loads[1].obstacle.point,
        "stiffness": lambda p: p.loads[1].stiffness,
    }
    tight = fem.Newton(residual_tolerance=1e-12)
    for where in places.values():
        start = where(base)
        way = jnp.array([0.0, 1e-4]) if start.ndim else 0.1 * start

        def height(amount, where=where, start=start, way=way):
            problem = eqx.tree_at(where, base, start + amount * way)
            return jnp.sum(fem.solve(problem, newton=tight).displacement[:, 1])

        slope = jax.jvp(height, (jnp.array(0.0),), (jnp.array(1.0),))[1]
        ahead, behind = height(jnp.array(1e-3)), height(jnp.array(-1e-3))
        assert jnp.allclose(slope, (ahead - behind) / 2e-3, rtol=1e-5)


def test_a_far_obstacle_adds_nothing_and_an_approaching_one_pushes():
    problem = _block()
    far = eqx.tree_at(lambda p: p.loads[1].value, problem, jnp.array([0.0, -1.0]))
    u = jnp.zeros_like(problem.mesh.points)
    assert far.loads[1].potential(far, u) == 0.0
    near = eqx.tree_at(lambda p: p.loads[1].value, problem, jnp.array([0.0, 1 * mm]))
    assert near.loads[1].potential(near, u) > 0.0


def test_a_cylinder_on_a_block_has_the_contact_of_hertz():
    """Width and peak of the pressure, and how far the block sinks under that pressure."""
    problem = fem_contact.pressed_block(32)
    down = jnp.stack([jnp.array([0.0, -depth]) for depth in fem_contact.APPROACHES])
    path = fem.solve_path(problem, cylinder=down)
    assert max(stats.iterations for stats in path.stats) <= 10
    assert sum(stats.cuts for stats in path.stats) == 0
    pressed = fem.with_load(problem, "cylinder", down[-1])
    state = fem.contact_state(pressed, path.displacements[-1], "cylinder")
    force = -2 * float(state.total[1])
    half_width, peak = fem_contact.hertz(force)
    assert abs(fem_contact.own_half_width(state) / half_width - 1) < 0.02
    assert abs(float(state.pressure.max()) / peak - 1) < 0.03
    sunk = fem_contact.block_approach(problem, force)
    assert abs(-float(down[-1, 1]) / sunk - 1) < 0.01


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stiffness": -1.0}, "stiffness.*must be positive"),
        ({"smoothing": 0.0}, "smoothing.*must be positive"),
        ({"value": np.zeros(3)}, "need \\(2,\\)"),
        ({"facets": np.zeros((0, 2), int)}, "acts on no facet"),
        ({"facets": np.array([[0, 99]])}, "names nodes"),
        ({"facets": np.array([[0, 1, 2]])}, "has 2 nodes"),
        ({"obstacle": sdf.Sphere([0.0, 0.0, 0.0], 1.0)}, "3 dimensions"),
    ],
)
def test_bad_contacts_are_refused(change, message):
    block = mesh.rectangle([0, 0], [1.0, 1.0], divisions=(2, 2), element=mesh.Quad4())
    arguments = {"facets": block.facet_sets["bottom"], "obstacle": FLOOR} | change
    with pytest.raises(ValueError, match=message):
        fem.problem(
            block,
            material.neo_hookean(young_modulus=1e5, poisson_ratio=0.3),
            kinematics=fem.PlaneStrain(),
            supports=(fem.Fixed(block.node_sets["top"]),),
            loads=(fem.Contact(**arguments),),
        )


def test_a_point_without_pressure_has_no_stiffness_where_it_stands():
    """Its slope there is that of free motion, as it is beside that place."""
    law, at = contact.SpringSlider(contact.Coulomb(0.5), 2.0**20), jnp.asarray([0.5, 0.25])
    grip = no_grip(at)
    for slope in (jax.hessian(law.energy, argnums=1), jax.jacobian(law.traction, argnums=1)):
        assert np.all(np.asarray(slope(grip, at)) == 0)
    pressed = grip._replace(pressure=jnp.asarray(2.0))
    assert np.allclose(jax.hessian(law.energy, argnums=1)(pressed, at), 2.0**20 * np.eye(2))


def test_a_number_is_the_coefficient_of_coulombs_law():
    law = contact.LinePenalty(1e6, 1e-5, friction=0.5)
    assert isinstance(law.friction, contact.Coulomb) and law.friction.coefficient == 0.5
    changed = sj.replace(law, lambda law: law.friction, 0.3)
    assert isinstance(changed.friction, contact.Coulomb)
    assert changed.friction.coefficient == 0.3
    with pytest.raises(ValueError, match="`coefficient` must be positive, got -1"):
        contact.LinePenalty(1e6, 1e-5, friction=-1.0)
    with pytest.raises(TypeError, match="friction"):
        contact.LinePenalty(1e6, 1e-5, friction="dry")  # type: ignore
    with pytest.raises(TypeError, match="DirectionalCoulomb.*Give a number or a Coulomb"):
        contact.LinePenalty(1e6, 1e-5, friction=contact.DirectionalCoulomb(0.2, 0.8, [1.0, 0]))
