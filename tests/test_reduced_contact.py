"""Reduced bodies in contact: friction that holds and slides, the full body beside it,
derivatives, and what is refused."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import fem, io, material, mesh, sdf, systems
from sorojax.math.status import Status
from sorojax.systems.blocks.modal_basis import Basis
from sorojax.systems.blocks.modal_body import AbstractModalForce
from sorojax.systems.blocks.sampled_body import snapshot_basis
from sorojax.systems.integrate.modal_step import modal_step
from sorojax.units import deg, mm

pytestmark = pytest.mark.versions
MU, G = 0.5, 9.81


def block(slope, friction: float | None = MU) -> systems.FemBody:
    """A block of rubber on a floor, under a weight that leans by `slope` [rad]."""
    cells = mesh.rectangle([0, 0], [20 * mm, 10 * mm], divisions=(4, 2))
    rubber = material.neo_hookean(young_modulus=1e5, poisson_ratio=0.3, density=1000.0)
    floor = fem.Contact(
        cells.facet_sets["bottom"],
        sdf.HalfPlane([0.0, 0.0], [0.0, 1.0]),
        1e7,
        friction=friction,
        name="floor",
    )
    lean = G * np.array([np.sin(slope), -np.cos(slope)])
    problem = fem.problem(
        cells,
        rubber,
        kinematics=fem.PlaneStrain(10 * mm),
        supports=(),
        loads=(fem.Gravity(lean), floor),
        free=True,
    )
    return systems.FemBody(problem, damping=fem.Rayleigh(stiffness=2e-3), driven=())


def reduced(body: systems.FemBody, modes: int = 6) -> Any:
    """In translations and some random shapes, with a linear force."""
    draw = np.random.default_rng(0)
    points = np.asarray(body.problem.mesh.points)
    bent = np.stack([draw.normal(size=2) @ _powers(points).T for _ in range(24)])
    field = jnp.asarray(1e-4 * np.stack([bent[:12], bent[12:]], axis=-1))
    return systems.modal_body(body, snapshot_basis(body, field, modes), order=1)


def _powers(points: np.ndarray) -> np.ndarray:
    x, y = points.T / 10e-3
    return np.stack([x * y, y**2 - 0.3 * x**2], axis=1)


def moved(body: Any, duration: float, step: float = 1e-3, save: int = 21) -> Any:
    network = systems.Network({"body": body}, {})
    return systems.simulate(network, duration, step=step, save=save)


def along(body: Any, film: Any) -> np.ndarray:
    """Mean displacement along the floor [m], and across."""
    mean = jnp.mean(body.basis.shapes, axis=1)
    return np.asarray(film.state["body"]["q"] @ mean)


def test_a_block_holds_below_the_angle_of_friction_and_does_not_creep():
    body = reduced(block(20 * deg))
    x = along(body, moved(body, 2.0, step=5e-3))[:, 0]
    assert 0 < x[-1] < 0.2 * mm
    assert abs(x[-1] - x[10]) < 1e-9


def test_a_block_slides_with_the_acceleration_of_coulomb():
    slope = 40 * deg
    body = reduced(block(slope))
    film = moved(body, 0.2)
    want = G * (np.sin(slope) - MU * np.cos(slope))
    time = np.asarray(film.time)
    found = np.polyfit(time[5:], along(body, film)[5:, 0], 2)[0] * 2
    np.testing.assert_allclose(found, want, rtol=2e-3)


def test_a_block_rests_on_the_pressure_of_its_weight():
    body = reduced(block(0.0, friction=None))
    contact = body.contacts[0]
    assert body.initial_state()["stretch"] == (None,)
    film = moved(body, 1.0, step=5e-3)
    q = film.state["body"]["q"][-1]
    pressure = contact.law.pressure(contact.gap(q))
    weight = 1000.0 * G * 20 * mm * 10 * mm * 10 * mm
    np.testing.assert_allclose(float(pressure @ contact.areas), weight, rtol=1e-6)


class Rounded(AbstractModalForce):
    """A force of zero at rest, but for rounding."""

    force: AbstractModalForce

    def __call__(self, q):
        noise = jnp.sin(1e27 * jax.lax.stop_gradient(q) + jnp.arange(1.0, 1.0 + len(q)))
        return self.force(q) - self.force(0 * q) + 1e-13 * noise

    def energy(self, q):
        return self.force.energy(q)


def test_a_block_without_load_stays_where_it_is():
    body = eqx.tree_at(lambda b: b.force, reduced(block(0.0)), replace_fn=Rounded)
    film = moved(body, 0.1)
    assert np.abs(along(body, film)).max() < 1e-13


def lip() -> systems.FemBody:
    """A cantilever above a floor, onto which a force at its end bends it."""
    cells = mesh.rectangle([0, 0], [60 * mm, 6 * mm], divisions=(20, 2), element=mesh.Quad8())
    rubber = material.neo_hookean(young_modulus=5e5, poisson_ratio=0.4, density=1000.0)
    floor = fem.Contact(
        cells.facet_sets["bottom"],
        sdf.HalfPlane([0.0, -4 * mm], [0.0, 1.0]),
        1e8,
        friction=0.4,
        name="floor",
    )
    problem = fem.problem(
        cells,
        rubber,
        kinematics=fem.PlaneStrain(10 * mm),
        supports=(fem.Fixed(cells.node_sets["left"]),),
        loads=(
            fem.Force(cells.node_sets["right"], [0.0, 0.0], name="push"),
            fem.Gravity([0.0, -G]),
            floor,
        ),
    )
    right = int(np.asarray(cells.node_sets["right"])[0])
    return systems.FemBody(
        problem,
        damping=fem.Rayleigh(stiffness=2e-3),
        driven=("push",),
        markers={"tip": right},
    )


def pushed(block, most, rise=0.1, step=1e-3):
    """The tip while a force [N] rises, pulls along the floor, and goes."""
    push = systems.Waypoints([0.0, rise, 2 * rise], [[0.0, 0.0], [0.0, -most], [most, -most]])
    network = systems.Network(
        {"body": block, "push": systems.Source(push, unit="N")}, {"body.push": "push.value"}
    )
    return systems.simulate(network, 0.3, step=step, save=61)


@functools.cache
def trained() -> systems.SampledBody:
    body = lip()
    motions = [pushed(body, most).state["body"]["u"] for most in (0.15, 0.35)]
    pushes = jnp.stack([0 * jnp.arange(9.0), -jnp.linspace(0, 0.1, 9)], axis=1)
    return systems.sampled_body(
        body, [{"push": pushes}], motions=motions, modes=10, tolerance=5e-3
    )


@pytest.mark.slow
def test_a_cantilever_on_a_floor_follows_the_full_body():
    """Pressed and pulled as it was not in training; the tip sticks, then slides."""
    full, small = pushed(lip(), 0.25), pushed(trained().body, 0.25)
    want, got = (x["body.tip_position"] - x["body.tip_position"][:1] for x in (full, small))
    assert jnp.max(jnp.abs(got - want)) < 0.01 * jnp.max(jnp.abs(want))
    assert float(small["body.reach"].max()) < 1.1


@pytest.mark.slow
def test_what_touched_nothing_in_training_may_touch_nothing_later():
    """Points near the clamp are left out; a floor that rises to them ends the model."""
    small = trained().body
    (floor,) = small.contacts
    assert len(floor.apart.places) > 0 and len(floor.places) > len(floor.apart.places)
    film = pushed(small, 0.25)
    nearest = jax.vmap(floor.clearance)(film.state["body"]["q"]).min()
    assert film.status == Status.successful and 0.4 * mm < nearest < 4 * mm
    higher = sdf.HalfPlane([0.0, nearest - 3.9 * mm], [0.0, 1.0])
    raised = eqx.tree_at(lambda b: b.contacts[0].apart.obstacle, small, higher)
    with pytest.raises(RuntimeError, match="left what its model describes"):
        pushed(raised, 0.25)


def end(numbers, body):
    """Where a block is after 30 ms, by its friction, its stiffness and the law of the floor."""
    changed = eqx.tree_at(
        lambda b: (
            b.contacts[0].slider.law.coefficient,
            b.contacts[0].law.stiffness,
            b.force.slope.terms[1],
        ),
        body,
        (MU * numbers[0], 1e7 * numbers[1], numbers[2] * body.force.slope.terms[1]),
    )
    film = moved(changed, 0.03, save=4)
    return 1e3 * jnp.sum(film.state["body"]["q"][-1])


def test_derivatives_are_those_of_differences():
    body, at = reduced(block(40 * deg)), jnp.ones(3)
    run = jax.jit(functools.partial(end, body=body))
    found = jax.grad(run)(at)
    np.testing.assert_allclose(jax.jacfwd(run)(at), found, rtol=1e-9)
    h, eye = 1e-5, jnp.eye(3)
    want = jnp.stack([(run(at + h * e) - run(at - h * e)) / (2 * h) for e in eye])
    np.testing.assert_allclose(found, want, rtol=1e-5, atol=1e-6 * jnp.max(jnp.abs(want)))


def test_members_of_a_batch_move_as_alone():
    body = reduced(block(30 * deg))
    h = jnp.asarray(1e-3)

    def run(v):
        state = body.initial_state() | {"v": v * jnp.ones_like(body.v)}
        for _ in range(3):
            state = modal_step(body, {}, state, 0 * body.v, h).state
        return state["q"]

    speeds = jnp.array([0.0, 1e-3, -2e-3])
    alone = jnp.stack([jax.jit(run)(v) for v in speeds])
    np.testing.assert_allclose(jax.jit(jax.vmap(run))(speeds), alone, rtol=1e-9, atol=1e-15)


def test_a_step_that_does_not_balance_ends_the_run():
    body = reduced(block(0.0))
    network = systems.Network({"body": body}, {})
    run = {"step": 1e-3, "save": 3, "throw": False}
    film = systems.simulate(network, 0.1, solver=systems.Staggered(passes=1), **run)
    assert bool(film.status == Status.not_converged)
    assert np.isfinite(np.asarray(film.state["body"]["q"])).all()


def test_methods_for_differential_equations_refuse_contact():
    network = systems.Network({"body": reduced(block(0.0))}, {})
    with pytest.raises(ValueError, match=r"body in contact.*Staggered\(\)"):
        systems.simulate(network, 0.1)
    alone = systems.Network({"lag": systems.Lag(0.1)}, {}, exposed=("lag.a",))
    with pytest.raises(ValueError, match="no network with a reduced body in contact"):
        systems.simulate(
            alone, 0.1, step=0.01, inputs={"lag.a": 1.0}, solver=systems.Staggered()
        )


def test_what_cannot_be_reduced_is_refused():
    body = block(0.0)
    driven = systems.FemBody(body.problem, driven=("floor",))
    push = fem.Force(np.array([0]), [0.0, 0.0], name="push")
    loads = (*body.problem.loads, push)
    problem = fem.problem(
        body.problem.mesh,
        body.problem.material,
        kinematics=body.problem.kinematics,
        supports=(),
        loads=loads,
        free=True,
    )
    pushable = systems.FemBody(problem, driven=("push",))
    basis = Basis(0 * body.problem.mesh.points, jnp.zeros((1, *body.problem.mesh.points.shape)))
    with pytest.raises(ValueError, match=r"driven obstacles \['floor'\]"):
        systems.modal_body(driven, basis)
    with pytest.raises(ValueError, match="no equilibria of its own, need motions"):
        systems.sampled_body(pushable, [{"push": jnp.zeros((9, 2))}], modes=4)
    with pytest.raises(ValueError, match="got 0 equilibria, 3 frames and 4 modes, need 8 fr"):
        systems.sampled_body(body, motions=[jnp.zeros((3, *basis.shapes.shape[1:]))], modes=4)


@pytest.mark.slow
def test_a_trained_body_in_contact_can_be_stored(tmp_path):
    small = trained()
    io.save(tmp_path / "small.npz", small)
    again = io.load(tmp_path / "small.npz")
    films = [pushed(each.body, 0.2, step=5e-3)["body.tip_position"] for each in (small, again)]
    np.testing.assert_array_equal(*films)
    assert float(jnp.ptp(films[0])) > 1 * mm
