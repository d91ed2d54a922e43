"""Supports that move along a path, and what they exert: reactions at rest and in motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import Status, fem, material, mesh, sdf
from sorojax.fem.problem import load_force
from sorojax.math.linalg import sparse

SHARP = fem.Newton(residual_tolerance=1e-12, step_tolerance=1e-9)
RUBBER = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.4, density=1000.0)
DEPTH = fem.PlaneStrain(0.01)


def _arch_under_a_post(post: float) -> fem.Problem:
    """Half of a shallow arch, one cell thick, below a post whose modulus is `post` times that
    of the arch: by symmetry its apex moves up and down only."""
    x = np.append(np.linspace(0, 0.095, 7), 0.1)
    y = np.append([0.0], np.linspace(0.002, 0.1, 4))
    grid = mesh.between_lines(x, y, element=mesh.Quad8())
    kept = mesh.cells_where(grid, lambda p: (p[1] < 0.002) | (p[0] > 0.095))
    part = mesh.submesh(grid, kept)
    points = np.array(part.points)
    points[:, 1] += 0.01 * np.minimum(points[:, 0] / 0.095, 1.0)
    part = mesh.Mesh(points, part.cells, part.element)
    above = np.asarray(part.points)[np.asarray(part.cells)].mean(axis=1)[:, 1] > 0.0125
    share = np.where(above, post, 1.0)
    rubber = material.NeoHookean(0.4e6 * share, 1e6 * share)
    foot = mesh.nodes_where(part, lambda p: p[0] < 1e-9)
    axis = mesh.nodes_where(part, lambda p: p[0] > 0.1 - 1e-9)
    top = mesh.nodes_where(part, lambda p: p[1] > points[:, 1].max() - 1e-9)
    supports = (
        fem.Fixed(foot),
        fem.Fixed(axis, components=(0,), name="symmetry"),
        fem.Prescribed(top, [-0.04], components=(1,), name="press"),
    )
    return fem.problem(part, rubber, kinematics=DEPTH, supports=supports)


def _turns(path) -> list[float]:
    return [float(p.factor) for p in path.critical_points if p.kind == "limit point"]


def test_a_support_presses_an_arch_beyond_the_greatest_displacement_it_can_take():
    """A soft post between hand and arch gives way: the displacement has a greatest value,
    after which it returns while the arch snaps through."""
    problem = _arch_under_a_post(3e-4)
    path = fem.continuation(problem, "press", step=0.08, largest_step=4e-3, max_states=60)
    assert path.status == Status.successful and path.factors[-1] >= 1.0
    assert path.values.shape == (len(path), 1)
    most, least = _turns(path)
    counts, factors = np.asarray(path.negative_eigenvalues), np.asarray(path.factors)
    unstable = np.flatnonzero(counts)
    assert counts[0] == counts[-1] == 0 and np.all(counts[unstable] == 1)
    assert np.all(np.diff(unstable) == 1)  # between the two turns
    before, after = factors[: unstable[0] + 1], factors[unstable[-1] :]
    assert before.max() <= most * (1 + 1e-6) and before.max() > 0.9 * most
    assert least < after.min() * (1 + 1e-6) and least < 0.7 * most
    top = problem.supports[2].nodes
    held = path.displacements[:, top, 1]
    np.testing.assert_allclose(held, path.values * jnp.ones((1, top.size)), atol=1e-12)
    np.testing.assert_allclose(path.critical_points[0].shape[top, 1], 0.0, atol=1e-12)
    stepped = fem.solve_path(problem, press=jnp.asarray(-0.04 * before[1:4, None]))
    np.testing.assert_allclose(stepped.displacements, path.displacements[1:4], atol=1e-9)


def test_a_path_may_name_a_support_that_turns():
    bar = mesh.rectangle([0, 0], [0.04, 0.01], divisions=(2, 1), element=mesh.Quad8())
    right = bar.node_sets["right"]
    supports = (
        fem.Fixed(bar.node_sets["left"]),
        fem.Rotated(right, bar.points[right], 0.6, [0.04, 0.005], name="wrist"),
    )
    problem = fem.problem(bar, RUBBER, kinematics=DEPTH, supports=supports)
    path = fem.continuation(problem, "wrist", step=0.5)
    np.testing.assert_allclose(path.values, 0.6 * path.factors, rtol=1e-12)
    here = fem.with_load(problem, "wrist", path.values[-1])
    found = fem.solve(here, newton=SHARP).displacement
    np.testing.assert_allclose(path.displacements[-1], found, atol=1e-9)
    with pytest.raises(ValueError, match="continuation: no load or moved support"):
        fem.continuation(problem, "elbow")


# ---- reactions


def _block() -> fem.Problem:
    """A block that is held, turned, pushed and heavy; two supports share nodes."""
    cells = mesh.box([0, 0, 0], [0.03, 0.01, 0.01], divisions=(2, 1, 1), element=mesh.Hex8())
    left, right = cells.node_sets["left"], cells.node_sets["right"]
    turned = fem.Rotated(right, cells.points[right], 0.3, [0.03, 0, 0], [1, 0, 0], name="chuck")
    supports = (
        fem.Fixed(left, name="wall"),
        turned,
        fem.Prescribed(left[:2], [1e-3], components=(2,), name="jack"),
    )
    loads = (
        fem.Gravity([0.0, -9.81, 1.0]),
        fem.Traction(cells.facet_sets["top"], [3e3, 0, -4e3]),
    )
    rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.3, density=1000.0)
    return fem.problem(cells, rubber, supports=supports, loads=loads)


def test_reactions_balance_the_loads_in_force_and_moment():
    problem, about = _block(), jnp.asarray([0.01, -0.02, 0.03])
    u = fem.solve(problem, newton=SHARP).displacement
    found = fem.reactions(problem, u, about=about)
    assert set(found) == {"wall", "chuck", "jack"}
    given = load_force(problem, u)
    arms = problem.mesh.points + u - about[None]
    force = sum(r.force for r in found.values())
    moment = sum(r.moment for r in found.values())
    size = max(float(jnp.max(jnp.abs(r.force))) for r in found.values())
    np.testing.assert_allclose(force, -jnp.sum(given, axis=0), atol=1e-10 * size)
    want = -jnp.sum(jnp.cross(arms, given), axis=0)
    np.testing.assert_allclose(moment, want, atol=1e-10 * size * 0.03)
    # what is not held carries nothing, and what is held twice counts once
    jack, wall = found["jack"], found["wall"]
    assert jnp.all(jack.forces[:, :2] == 0) and jnp.all(jack.forces[:, 2] != 0)
    assert jnp.all(wall.forces[:2, 2] == 0) and jnp.all(wall.forces[2:, 2] != 0)
    np.testing.assert_allclose(jnp.sum(jack.forces, axis=0), jack.force)


def test_a_body_of_revolution_is_pulled_along_its_axis():
    """A rod of circular section: force over section is the stress of uniaxial tension."""
    tube = mesh.rectangle([0, 0], [0.01, 0.03], divisions=(1, 1), element=mesh.Quad8())
    supports = (
        fem.Fixed(tube.node_sets["left"], components=(0,)),
        fem.Fixed(tube.node_sets["bottom"], components=(1,), name="foot"),
        fem.Prescribed(tube.node_sets["top"], [0.03 * 1e-6], components=(1,), name="pull"),
    )
    problem = fem.problem(tube, RUBBER, kinematics=fem.Axisymmetric(), supports=supports)
    found = fem.reactions(problem, fem.solve(problem, newton=SHARP).displacement)
    want = 1e6 * 1e-6 * np.pi * 0.01**2
    np.testing.assert_allclose(found["pull"].force, [0, want], rtol=1e-5)
    np.testing.assert_allclose(found["foot"].force, -found["pull"].force, rtol=1e-8)
    assert found["pull"].moment.shape == (1,)


@pytest.mark.parametrize("kinematics", [fem.PlaneStrain(0.5), fem.Axisymmetric()])
@pytest.mark.parametrize("origin", [None, [0.0, -0.1]])
def test_pressure_in_an_open_cavity_pushes_its_walls_alone(kinematics, origin):
    """A cup upside down, held at its rim: it is pushed up by pressure times opening."""
    sheet = mesh.rectangle([0, 0], [0.03, 0.05], divisions=(3, 5))
    cup = mesh.submesh(sheet, mesh.cells_where(sheet, lambda p: (p[0] > 0.02) | (p[1] > 0.04)))
    rim = np.flatnonzero(np.asarray(cup.points)[:, 1] == 0)
    inside = mesh.facets_on(cup, sdf.Rectangle([-0.01, 0.0], [0.02, 0.04]))
    supports = (
        fem.Fixed(cup.node_sets["left"], components=(0,)),
        fem.Fixed(rim, name="rim"),
    )
    loads = (fem.Pressure(inside, 2e3, origin=origin),)
    problem = fem.problem(cup, RUBBER, kinematics=kinematics, supports=supports, loads=loads)
    u = fem.solve(problem, newton=SHARP).displacement
    opening = np.pi * 0.02**2 if isinstance(kinematics, fem.Axisymmetric) else 0.02 * 0.5
    force = fem.reactions(problem, u)["rim"].force[1]
    np.testing.assert_allclose(force, -2e3 * opening, rtol=1e-8)
    np.testing.assert_allclose(fem.reaction_force(problem, u, rim)[1], force, rtol=1e-12)
    if origin is None:
        still = fem.simulate(problem, 2e-3, 1e-3, start=(u, 0 * u))
        moving = fem.reaction_history(still)["rim"].force[:, 1]
        np.testing.assert_allclose(moving, force, rtol=1e-6)


@pytest.mark.parametrize("origin", [None, [0.0, 0.0, -0.1]])
def test_pressure_in_an_open_cavity_in_space_pushes_its_walls_alone(origin):
    block = mesh.box([0, 0, 0], [0.03, 0.03, 0.03], divisions=(3, 3, 3))
    low, high = jnp.array([0.01, 0.01, -0.01]), jnp.array([0.02, 0.02, 0.02])
    cup = mesh.submesh(
        block, mesh.cells_where(block, lambda p: jnp.any((p < low) | (p > high)))
    )
    rim = np.flatnonzero(np.asarray(cup.points)[:, 2] == 0)
    loads = (fem.Pressure(mesh.facets_on(cup, sdf.Box(low, high)), 2e3, origin=origin),)
    problem = fem.problem(cup, RUBBER, supports=(fem.Fixed(rim, name="rim"),), loads=loads)
    u = fem.solve(problem, newton=SHARP).displacement
    np.testing.assert_allclose(fem.reactions(problem, u)["rim"].force[2], -0.2, rtol=1e-8)


def test_a_reaction_has_a_derivative_by_material_and_place():
    problem = _block()

    def chuck(shift, modulus):
        rubber = material.NeoHookean(modulus, 1e6, density=1000.0)
        points = problem.mesh.points + shift * jnp.asarray([0.0, 1.0, 0.0])[None]
        at = eqx.tree_at(lambda p: (p.mesh.points, p.material), problem, (points, rubber))
        found = fem.reactions(at, fem.solve(at, newton=SHARP).displacement)["chuck"]
        return jnp.sum(found.force * jnp.asarray([1.0, 2.0, 3.0])) + 50 * jnp.sum(found.moment)

    at, steps = (jnp.asarray(0.001), jnp.asarray(4e5)), (1e-5, 1e2)
    slopes = jax.grad(chuck, argnums=(0, 1))(*at)
    for k, step in enumerate(steps):
        moved = [
            tuple(a + s * step * (j == k) for j, a in enumerate(at)) for s in (-2, -1, 1, 2)
        ]
        low2, low, high, high2 = (chuck(*m) for m in moved)
        want = (low2 - 8 * low + 8 * high - high2) / (12 * step)
        np.testing.assert_allclose(slopes[k], want, rtol=1e-7)


# ---- reactions in motion


LENGTH, SIDE = 0.1, 0.01
SPEED, RATE = 10.0, 150.0  # of waves [m/s], of the shaker [rad/s]


def shaken_bar():
    """A slender bar whose foot is shaken, from the exact standing wave on; displacement and
    force at the foot by d'Alembert's equation."""
    cells = mesh.rectangle([0, 0], [LENGTH, SIDE], divisions=(8, 1), element=mesh.Quad8())
    law = material.StVenantKirchhoff(0.5e5, 1e5 / 3, density=1000.0)  # E = 1e5, nu = 0
    size, number = 1e-7, RATE / SPEED

    def foot(t):
        return size * jnp.sin(RATE * t)

    supports = (fem.Prescribed(cells.node_sets["left"], [0.0, 0.0], name="foot"),)
    problem = fem.problem(cells, law, kinematics=fem.PlaneStress(SIDE), supports=supports)
    shape = jnp.cos(number * (LENGTH - cells.points[:, 0])) / np.cos(number * LENGTH)
    velocity = jnp.zeros_like(cells.points).at[:, 0].set(size * RATE * shape)
    stiffness = 1e5 * SIDE**2 * number * np.tan(number * LENGTH)
    return problem, velocity, foot, lambda t: -stiffness * foot(t)


def _shaken(step: float):
    problem, velocity, foot, force = shaken_bar()
    motion = fem.simulate(
        problem,
        0.03,
        step,
        start=(jnp.zeros_like(velocity), velocity),
        foot=lambda t: jnp.stack([foot(t), 0 * t]),
    )
    return motion, fem.reaction_history(motion)["foot"], force


def test_reactions_of_a_shaken_bar_are_those_of_its_waves_to_second_order():
    errors = []
    for step in (1e-3, 5e-4):
        motion, foot, force = _shaken(step)
        want = jax.vmap(force)(motion.time)
        errors.append(float(jnp.max(jnp.abs(foot.force[:, 0] - want)) / jnp.max(jnp.abs(want))))
    assert errors[1] < 0.02 and errors[0] / errors[1] > 3.3


def test_reactions_change_the_momentum():
    """Force and moment of a turned support, a fixed one and a weight: rates of the momenta."""
    bar = mesh.rectangle([0, 0], [0.04, 0.01], divisions=(3, 1), element=mesh.Quad8())
    left = bar.node_sets["left"]
    turned = fem.Rotated(left, bar.points[left], 0.0, [0.0, 0.02], name="hand")
    problem = fem.problem(
        bar, RUBBER, kinematics=DEPTH, supports=(turned,), loads=(fem.Gravity(),)
    )
    motion = fem.simulate(problem, 0.02, 2.5e-4, hand=lambda t: 0.3 * (1 - jnp.cos(200 * t)))
    hand = fem.reaction_history(motion)["hand"]
    p, spin = fem.momentum(motion)
    rate, turning = ((x[2:] - x[:-2]) / (2 * 2.5e-4) for x in (p, spin))
    mass = fem.total_mass(problem)
    weight = jnp.asarray([[0.0, -9.81]]) * mass
    middle = jax.vmap(lambda u: _centre(problem, u))(motion.displacements)[1:-1]
    size = float(jnp.max(jnp.abs(rate)))
    miss = jnp.max(jnp.abs(hand.force[1:-1] + weight - rate))
    assert miss < 0.02 * size
    moment = hand.moment[1:-1, 0] - 9.81 * mass * middle[:, 0]
    assert jnp.max(jnp.abs(moment - turning[:, 0])) < 0.02 * jnp.max(jnp.abs(turning))


def _centre(problem, u):
    mass = sparse.product(
        problem.space.system, fem.mass_matrix(problem), (problem.mesh.points + u).ravel()
    )
    return jnp.sum(mass.reshape(u.shape), axis=0) / fem.total_mass(problem)


def test_a_reaction_in_motion_has_a_derivative():
    bar = mesh.rectangle([0, 0], [0.04, 0.01], divisions=(1, 1), element=mesh.Quad4())
    left = bar.node_sets["left"]
    foot = fem.Prescribed(left, [0.0, 0.0], name="foot")
    problem = fem.problem(bar, RUBBER, kinematics=DEPTH, supports=(foot,))

    def pushed(size):
        row = size * jnp.asarray([[0, 0], [1.0, 0.5], [1.5, 2.0], [0.5, 1.0], [0.0, 0.3]])
        motion = fem.simulate(problem, 4e-3, 1e-3, foot=row, newton=SHARP)
        found = fem.reaction_history(motion)["foot"]
        return jnp.sum(jnp.sin(found.forces)) + jnp.sum(found.moment)

    at, step = 1e-3, 1e-5
    low2, low, high, high2 = (pushed(at + k * step) for k in (-2, -1, 1, 2))
    want = (low2 - 8 * low + 8 * high - high2) / (12 * step)
    np.testing.assert_allclose(jax.grad(pushed)(at), want, rtol=1e-6)


def test_reactions_along_a_path_are_those_of_each_state():
    bar = mesh.rectangle([0, 0], [0.04, 0.01], divisions=(2, 1), element=mesh.Quad8())
    right = fem.Prescribed(bar.node_sets["right"], [0.0, 0.0], name="hand")
    wall = fem.Fixed(bar.node_sets["left"], name="wall")
    problem = fem.problem(bar, RUBBER, kinematics=DEPTH, supports=(wall, right))
    pull = jnp.stack([jnp.linspace(0, 4e-3, 3), jnp.zeros(3)], axis=1)
    path = fem.solve_path(problem, hand=pull)
    found = fem.reaction_history(path)
    rounding = 1e-13 * jnp.max(jnp.abs(found["hand"].force))
    for k in range(3):
        each = fem.reactions(path.problem_at(k), path.displacements[k])
        for name in ("wall", "hand"):
            force = each[name].force
            assert jnp.allclose(found[name].force[k], force, rtol=1e-12, atol=rounding)


def test_the_reaction_to_a_held_stretch_relaxes_to_its_long_term_share():
    bar = mesh.rectangle([0, 0], [0.04, 0.01], divisions=(2, 1), element=mesh.Quad8())
    right = fem.Prescribed(bar.node_sets["right"], [0.0, 0.0], name="hand")
    wall = fem.Fixed(bar.node_sets["left"], name="wall")
    relaxing = material.Viscoelastic(RUBBER, material.Prony([0.4], [0.05]))
    problem = fem.problem(bar, relaxing, kinematics=DEPTH, supports=(wall, right))
    times = jnp.array([0.0, 1e-4, 0.1, 0.5, 1.0])
    pull = jnp.stack([jnp.array([0.0, 1e-5, 1e-5, 1e-5, 1e-5]), jnp.zeros(5)], axis=1)
    path = fem.solve_path(problem, times=times, hand=pull)
    found = fem.reaction_history(path)
    assert jnp.allclose(found["wall"].force, -found["hand"].force, rtol=0, atol=1e-9)
    at_first, at_last = found["hand"].force[jnp.array([1, 4]), 0]
    elastic = fem.problem(bar, RUBBER, kinematics=DEPTH, supports=(wall, right))
    rest = fem.reaction_history(fem.solve_path(elastic, hand=pull[:2]))["hand"].force[1, 0]
    assert abs(at_last / rest - 1) < 1e-4
    assert 1.25 < at_first / rest < 1.4  # the branch adds 40 % of the shear modulus alone
