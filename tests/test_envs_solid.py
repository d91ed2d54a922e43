"""Tasks of reduced solids: another rubber, where the training is kept, and the full body."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.cases import envs_solid
from sorojax import envs, fem, io, systems
from sorojax.envs import solids
from sorojax.envs.tasks import solid_crawler, solid_finger
from sorojax.envs.tasks.crawl import FloorGoal
from sorojax.math.linalg.sparse import product
from sorojax.systems.blocks.modal_basis import coordinates
from sorojax.systems.blocks.modal_body import (
    AbstractModalForce,
    ProjectedForce,
    modal_body,
    without_contacts,
)
from sorojax.systems.blocks.sampled_body import snapshot_basis
from sorojax.systems.blocks.sampled_force import pieces, sampled_force

SETTINGS = {"size": 4e-3, "modes": 6, "tolerance": 0.01}


@pytest.fixture(scope="module")
def small():
    return envs.solid_finger(**SETTINGS)


def every_cell(full, basis, viscosity):
    """The body in the same shapes with the force of all cells, of a rubber of its own."""
    count = full.problem.mesh.num_cells
    force = sampled_force(full, basis, np.arange(count), np.ones(count))
    force = eqx.tree_at(
        lambda f: (f.viscosity, f.trained),
        force,
        (jnp.full(count, viscosity), jnp.ones(())),
        is_leaf=lambda x: x is None,
    )
    still = eqx.tree_at(lambda b: b.damping, full, ())
    return eqx.tree_at(lambda b: b.force, modal_body(still, basis, order=None), force)


def test_another_rubber_is_that_of_a_body_made_of_it(small, getkey):
    """Force and motion of the same shapes: unit modal mass of the heavier body is that of the
    lighter one times the square root of the factor."""
    stiffness, damping, density = 1.3, 0.7, 1.8
    basis, viscosity = small.reduced.body.basis, 1000.0
    plain = every_cell(solid_finger.full_finger(4e-3), basis, viscosity)
    full = solid_finger.full_finger(4e-3, stiffness=stiffness, damping=damping, density=density)
    root = density**0.5
    own = eqx.tree_at(lambda b: b.shapes, basis, basis.shapes / root)
    mass = coordinates(full, own, own.shapes[2])
    np.testing.assert_allclose(mass, np.eye(len(own))[2], atol=1e-9)
    want = every_cell(full, own, viscosity * damping)
    got = solids.of_rubber(
        plain, solids.Rubber(*map(jnp.asarray, (stiffness, damping, density)))
    )
    q = 1e-4 * jax.random.normal(getkey(), plain.q.shape)
    v = 1e-2 * jax.random.normal(getkey(), plain.q.shape)
    air = {"left_pressure": jnp.asarray(4e3), "right_pressure": jnp.asarray(1e3)}
    wanted = want.pull(root * q, root * v, air) * root
    np.testing.assert_allclose(got.body.pull(q, v, air), wanted, rtol=1e-9, atol=1e-9)
    assert float(got.mass) == density


def test_the_viscosity_of_all_cells_is_that_of_the_body_where_it_is_bent(small):
    """Beside the damping matrix of `fem.KelvinVoigt`, far from rest."""
    full, basis = solid_finger.full_finger(4e-3), small.reduced.body.basis
    body = every_cell(full, basis, 1000.0)
    q = solids.settled(solids.Solid(body, jnp.ones(())), jnp.asarray([12e3, 0.0])).q
    u = jnp.tensordot(q, basis.shapes, 1)
    assert float(jnp.max(jnp.abs(u))) > 10e-3
    problem = full.problem
    values = full.damping[0].matrix(problem, full.matter().mass, u)
    moved = [product(problem.space.system, values, s.ravel()) for s in basis.shapes]
    want = np.stack(moved) @ np.asarray(basis.shapes).reshape(len(basis), -1).T
    got = body.force.viscous_matrix(q)
    np.testing.assert_allclose(got, want, atol=1e-10 * np.abs(want).max())
    v = jnp.arange(1.0, 1 + len(basis)) * 1e-3
    by_rates = jax.jacfwd(body.force.viscous, 1)(q, v)
    np.testing.assert_allclose(by_rates, got, atol=1e-10 * np.abs(want).max())
    slope = jax.jacfwd(body.force.viscous)(q, v)
    known = jax.jacfwd(lambda q: body.force.viscous_matrix(q) @ v)(q)
    np.testing.assert_allclose(slope, known, atol=1e-10 * np.abs(known).max())


def test_the_matrix_of_a_step_is_the_derivative_of_the_forces_at_rest(small):
    air = {"left_pressure": jnp.asarray(9e3), "right_pressure": jnp.asarray(1e3)}
    body, rate, zero = small.reduced.body, 300.0, jnp.zeros_like(small.reduced.body.q)
    q = solids.settled(solids.Solid(body, jnp.ones(())), jnp.asarray([12e3, 0.0])).q
    by_q, by_v = (jax.jacfwd(lambda *at: -body.pull(*at, air), n)(q, zero) for n in range(2))
    want = by_q + rate * by_v
    got = body.tangent(q, air, rate)
    np.testing.assert_allclose(got, want, atol=1e-10 * np.abs(want).max())
    got, want = body.force.tangent(q, rate), AbstractModalForce.tangent(body.force, q, rate)
    np.testing.assert_allclose(got, want, atol=1e-10 * np.abs(want).max())


def test_all_cells_make_the_force_of_the_mesh(small):
    full, basis = solid_finger.full_finger(4e-3), small.reduced.body.basis
    body = every_cell(full, basis, 1000.0)
    free = full.loaded({"left": jnp.zeros(()), "right": jnp.zeros(())})
    q = 1e-5 * jnp.arange(1.0, 1 + len(basis))
    want = ProjectedForce(free, basis)(q)
    np.testing.assert_allclose(body.force(q), want, atol=1e-10 * float(jnp.abs(want).max()))


def test_steps_are_of_second_order(small):
    """A quarter of the error by steps of half the length."""
    solid = solids.Solid(small.reduced.body, jnp.ones(()))
    start = solids.SolidBody(small.reduced.body.q, small.reduced.body.v)

    def air(t):
        return 8e3 * jnp.stack([1 - jnp.cos(20 * t), jnp.sin(15 * t) ** 2])

    def end(steps):
        return solids.rolled(solid, start, air, time_step=0.16 / steps, steps=steps).q

    fine = end(2560)
    errors = [float(jnp.linalg.norm(end(n) - fine)) for n in (40, 80, 160)]
    assert 3.3 < errors[0] / errors[1] < 5 and 3.3 < errors[1] / errors[2] < 5


def test_a_body_that_is_strained_beyond_its_training_ends_the_episode(small, getkey):
    env = envs.SolidReach(body=small)
    params = eqx.tree_at(lambda p: p.stiffness, env.default_params(), jnp.asarray(0.4))
    state, _ = envs.reset(env, getkey(), env.default_params())
    full = jnp.asarray([1.0, -1.0])
    over = []
    for _ in range(30):
        after = envs.step(env, getkey(), state, full, params)
        state = after.state
        over.append(bool(after.info["diverged"]))
    assert any(over) and not over[0] and bool(jnp.isfinite(state.body.q).all())


def test_single_precision_is_that_of_the_process_and_moves_alike(small):
    """Trained in double precision all the same; motion to 1e-4 of the largest coordinate."""
    with jax.enable_x64(False):
        single = envs.solid_finger(**SETTINGS)
    numbers = [x for x in jax.tree.leaves(single) if eqx.is_inexact_array(x)]
    assert numbers and all(x.dtype == jnp.float32 for x in numbers)
    air = 0.8 * solid_finger.MAX_PRESSURE * jnp.eye(2)
    want = envs_solid.held_steps(small.reduced.body, 50, air)
    got = envs_solid.held_steps(single.reduced.body, 50, air.astype(jnp.float32))
    for a, b in zip(got, want, strict=True):
        assert a.dtype == jnp.float32
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-4 * float(jnp.abs(b).max()))


def test_a_training_is_kept_and_a_damaged_file_trained_again(small, tmp_path, monkeypatch):
    monkeypatch.setenv("SOROJAX_CACHE", str(tmp_path))
    calls = []

    def trained(*settings):
        calls.append(settings)
        return small

    monkeypatch.setattr(solid_finger, "_trained", trained)
    first, again = (envs.solid_finger(**SETTINGS) for _ in range(2))
    assert len(calls) == 1 and first is small
    same = zip(jax.tree.leaves(again), jax.tree.leaves(small), strict=True)
    assert all(np.array_equal(a, b) for a, b in same)
    (file,) = (tmp_path / "trained").glob("*.npz")
    file.write_bytes(file.read_bytes()[:1000])
    envs.solid_finger(**SETTINGS)
    assert len(calls) == 2 and io.load(file).mesh.num_cells == small.mesh.num_cells
    envs.solid_finger(**SETTINGS | {"modes": 7})
    assert len(calls) == 3
    with pytest.raises(ValueError, match="solid_finger: `size` must be positive"):
        envs.solid_finger(-1.0)


def test_another_rubber_and_floor_of_a_crawler_are_those_of_its_mesh():
    """With the force of all points: accelerations by factors are those of a body that was
    assembled with the rubber, on the floor."""
    usual = solid_crawler.full_crawler()
    points = usual.problem.mesh.points
    draw = np.random.default_rng(3)
    x, y = np.asarray(points / 0.1).T
    field = 1e-3 * np.stack([x * y, x**2, y - x, x**3 * y, x**2 * y])[:, :, None]
    basis = snapshot_basis(usual, jnp.asarray(field * draw.normal(size=(5, 1, 2))), 6)
    cells, quad = pieces(usual)

    def assembled(full):
        free = without_contacts(full)
        force = sampled_force(free, basis, cells, np.ones(len(cells)), quad)
        small = modal_body(full, basis, order=None)
        return eqx.tree_at(lambda b: b.force, small, dataclasses.replace(force, trained=1.0))

    axes = [jnp.broadcast_to(axis, points.shape) for axis in jnp.eye(2)]
    weight = jnp.stack([coordinates(usual, basis, axis) for axis in axes])
    none = jnp.zeros(1), jnp.zeros(()), jnp.zeros(()), jnp.zeros(())
    known = systems.SampledBody(assembled(usual), jnp.zeros(1, int), *none, 1)
    body = solid_crawler.SolidCrawler(usual.problem.mesh, known, weight)
    env = envs.SolidCrawl(body=body)
    stiffness, density, friction, slope = 1.3, 0.8, 0.7, 0.1
    params = envs.SolidCrawlParams(stiffness, density=density, friction=friction)
    got = env._solid(params, FloorGoal(jnp.asarray(slope)))
    factors = {"stiffness": stiffness, "density": density}
    want = assembled(solid_crawler.full_crawler(friction=friction, slope=slope, **factors))
    q = jnp.asarray(2e-5 * draw.normal(size=6)) - 1e-3 * weight[1]
    air = {f"{name}_pressure": jnp.asarray(5e3) for name in solid_crawler.PORTS}
    over = {name: x / density for name, x in air.items()}
    pull = want.pull(q, 0 * q, air) / density
    np.testing.assert_allclose(got.pull(q, 0 * q, over), pull, rtol=1e-9)
    h, (one,), (other,) = jnp.asarray(1e-3), got.contacts, want.contacts
    # whose smoothing follows the rubber that it is made with
    other = dataclasses.replace(other, law=one.law)
    grips = [c.begun(q, c.unstretched(), h) for c in (one, other)]
    ahead = q + 1e-5 * weight[0]
    push = other.push(ahead, grips[1]) / density
    assert float(jnp.abs(push).max()) > 0
    np.testing.assert_allclose(one.push(ahead, grips[0]), push, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_a_crawler_goes_as_far_as_the_whole_one():
    """Under a gait that was not in the training, on another floor: six tenths of a second."""
    env = envs.SolidCrawl(body=solid_crawler.solid_crawler(), time_step=1e-3, substeps=20)
    slope, friction = 0.01, 0.8
    params = envs.SolidCrawlParams(friction=friction)
    time = 2e-3 * np.arange(301)
    waves = np.maximum(np.sin(9 * time[None] - 1.3 * np.arange(2)[:, None]), 0.0)
    pressures = jnp.asarray(0.9 * solid_crawler.MAX_PRESSURE * waves)
    full = solid_crawler.full_crawler(friction=friction, slope=slope)
    given = dict(zip(solid_crawler.PORTS, pressures, strict=True))
    motion = fem.simulate(full.problem, 0.6, 2e-3, damping=full.damping, **given)
    nodes = np.array([node for _, node in full.markers])
    want = motion.displacements[::10, nodes]
    body, seen = env.resting(params), []
    goal = FloorGoal(jnp.asarray(slope))

    @jax.jit
    def moved(body, start):
        def air(t):
            return jnp.stack([jnp.interp(start + t, time, row) for row in pressures])

        return env.moved(body, air, goal, params)

    first = env.markers(body, params)
    for k in range(30):
        body, fine = moved(body, 0.02 * k)
        assert bool(fine)
        seen.append(env.markers(body, params) - first)
    off = jnp.abs(jnp.stack(seen) - want[1:])
    assert float(off.max()) < 0.05 * float(jnp.ptp(want[..., 1]))
    way, along = float(jnp.mean(seen[-1][:, 0])), float(jnp.mean(want[-1, :, 0]))
    assert along > 2e-3 and abs(way / along - 1) < 0.03


@pytest.mark.slow
def test_the_tip_is_where_that_of_the_whole_finger_is():
    """Under pressures that were not in the training, of both sides."""
    env, acts = envs.SolidReach(), envs_solid.actions(101)
    tips = envs_solid.reduced_tip(env, acts)
    off, move = envs_solid.error_of(tips, envs_solid.whole_tip(env, acts))
    assert move > 15e-3 and off < 0.01 * move
