"""Stress cases of motion, contact, events and batches."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.cases import contact_grid
from sorojax import rod as R, sdf, systems as S
from sorojax.contact import LinePenalty
from sorojax.math.lie import SE2
from sorojax.math.ode.contact_midpoint import Span, passed_on_way
from sorojax.math.ode.steppers import GeneralisedAlpha, Kinematic, RungeKutta4
from sorojax.math.status import Status
from sorojax.rod.dynamics.rollout import second_order

RADIUS = 6e-3
FINGER = dict(length=0.08, young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
ROD = R.rod(SE2(), R.chebyshev(kappa_z=2), R.circle(RADIUS), nodes=8, **FINGER)
LAW = LinePenalty(stiffness=5e7, smoothing=6e-6, friction=0.5)
BENT = jnp.array([5.0, -2.0])
G = jnp.array([0.0, -9.81])


def energy(q, v, gravity=None):
    return R.kinetic_energy(ROD, q, v) + R.potential_energy(ROD, q, gravity)


@pytest.mark.stress(36)
def test_nothing_at_all_is_a_scene():
    empty = S.Network({}, {})
    film = S.simulate(empty, 1.0, save=3)
    assert film.status == Status.successful and film.time.shape == (3,)
    still = R.rollout(ROD, BENT, 0 * BENT, step=1e-3, saves=0)
    assert still.q.shape == (1, 2) and jnp.array_equal(still.q[0], BENT)
    nothing = sdf.Circle([0.0, 0.0], 1.0) & sdf.Circle([5.0, 0.0], 1.0)
    assert nothing(jnp.zeros(2)) > 0 and jnp.all(jnp.isfinite(jax.grad(nothing)(jnp.zeros(2))))


@pytest.mark.stress(39)
@pytest.mark.parametrize("explicit", [True, False])
def test_a_step_a_hundred_times_too_long(explicit):
    fastest = jnp.sqrt(
        jnp.linalg.eigvals(
            jnp.linalg.solve(R.mass_matrix(ROD, 0 * BENT), R.stiffness_matrix(ROD))
        ).real.max()
    )
    step = 100 * 2.8 / float(fastest)
    if explicit:
        film = R.rollout(ROD, BENT, 0 * BENT, step=step, saves=10, stepper=RungeKutta4())
        assert film.status == Status.not_finite
    else:
        film = R.rollout(ROD, BENT, 0 * BENT, step=step, saves=200, stepper=GeneralisedAlpha())
        assert film.status == Status.unstable
        assert energy(film.q[-1], film.v[-1]) <= energy(BENT, 0 * BENT)


FLOOR = sdf.Rectangle([-1.0, -1.0], [1.0, -0.012])
CONTACT = R.ObstacleContact(FLOOR, RADIUS, LAW, points=16)


@pytest.fixture(scope="module")
def swing():
    """The rod above the floor, from a bend and a rate."""

    @eqx.filter_jit
    def film(q, v, step, contact=CONTACT):
        forces = (R.Gravity(G), contact, R.Damping(1e-3))
        path = R.rollout(ROD, q, v, forces, step=step, saves=200)
        total = jax.vmap(
            lambda q, v: energy(q, v, G) + R.contact_energy(contact, R.motion(ROD, q))
        )(path.q, path.v)
        depth = jax.vmap(lambda q: R.penetration(contact, R.motion(ROD, q)))(path.q)
        return path, total, depth

    return film


def rise(total):
    total = np.asarray(total)
    return float(np.max(total - np.minimum.accumulate(total)))


@pytest.mark.stress(40)
def test_a_tip_at_a_hundred_metres_per_second_does_not_get_through(swing):
    v = jnp.array([-100.0 / 0.08**2 * 2, 0.0])
    path, total, depth = swing(0 * BENT, v, jnp.array(2e-6))
    tip = jax.vmap(lambda q, v: R.jacobian(ROD, q)[-1] @ v)(path.q, path.v)
    assert path.status == Status.successful and jnp.abs(tip[0]).max() > 90
    assert 0 < depth.max() < RADIUS and rise(total) < 0.01 * float(total[0])


@pytest.fixture(scope="module")
def impact():
    """(kind, speed, wall, step) -> status, through, largest energy over the first."""
    runs = {}

    def run(kind, *cell):
        scene = contact_grid.SCENES[kind]
        made = runs.setdefault(kind, contact_grid.run_of(scene))
        return made(*(jnp.asarray(number) for number in cell))[:3]

    return run


@pytest.mark.parametrize(
    ("kind", "speed", "wall", "step"),
    [
        pytest.param("shape", 5.0, 2e-3, 1e-3, marks=pytest.mark.stress(76)),
        pytest.param("shape", 50.0, 2e-3, 2e-4, marks=pytest.mark.stress(76)),
        pytest.param("shape", 20.0, 2e-3, 1e-3, marks=pytest.mark.stress(76)),
        pytest.param("rod", 20.0, 2e-3, 1e-3, marks=pytest.mark.stress(77)),
        pytest.param("link", 50.0, 1e-3, 2e-4, marks=pytest.mark.stress(77)),
        pytest.param("itself", 20.0, 4e-3, 1e-3, marks=pytest.mark.stress(78)),
        pytest.param("itself", 50.0, 8e-3, 2e-4, marks=pytest.mark.stress(78)),
    ],
)
def test_nothing_is_jumped_over(impact, kind, speed, wall, step):
    status, through, most = impact(kind, speed, wall, step)
    assert status == Status.successful and not through
    assert most <= contact_grid.GAINED


@pytest.mark.stress(78)
def test_a_rod_that_goes_through_itself_and_out_again_in_one_step_is_seen():
    """Its shape turns by a whole turn on the way, which chords of the step do not show."""
    wall, h = jnp.asarray(3.5e-3), jnp.asarray(1e-3)
    model, forces = contact_grid.on_itself(wall)
    begin, end = jnp.array([56.7, -5.1, 70.8]), jnp.array([18.6, -26.5, -0.1])
    scene = contact_grid.SCENES["itself"]
    assert contact_grid.met_between(scene, model, wall, begin[None], end[None])[0]
    rate, problem = (end - begin) / h, second_order(model, begin, forces)
    state = Kinematic(begin, rate, 0 * rate)
    for long, seen in ((True, True), (False, False)):
        step = Span(0 * h, h, h / 2)
        found = passed_on_way(problem, step, state, rate, jnp.array(long))
        assert bool(found) == seen


@pytest.mark.stress(79)
def test_what_contact_cannot_hold_is_said_and_does_not_pass(impact):
    """It would sink in by more than its radius and half the wall."""
    status, through, most = impact("shape", 100.0, 1e-3, 2e-5)
    assert status == Status.unresolved and not through
    assert most <= contact_grid.GAINED


@pytest.mark.stress(80)
def test_one_member_that_tunnels_is_cut_and_differentiable():
    model, forces = contact_grid.on_shape(jnp.asarray(2e-3))

    def end(speed):
        q, v = contact_grid.falling(None)(model, speed, jnp.asarray(2e-3))
        return R.rollout(model, q, v, forces, step=1e-3, saves=2).q[-1]

    @jax.jit
    @jax.vmap
    def every(speed):
        place, ahead = jax.linearize(end, speed)
        return place, ahead(jnp.ones_like(speed)), jax.grad(lambda x: end(x)[2])(speed)

    # Between speeds at which the number of parts of a step changes, and with it the answer.
    change = 1e-4
    speeds = jnp.array([0.5, 19.5, 19.5 - change, 19.5 + change])
    place, slope, back = every(speeds)
    assert jnp.abs(place[0, 2] - 9e-3 + 0.5 * 2e-3) < 1e-12  # in free fall
    assert jnp.all(place[1:, 2] > 0)  # 40 mm on, and not through
    apart = (place[3] - place[2]) / (2 * change)
    assert jnp.allclose(slope[1], apart, rtol=1e-3, atol=1e-3 * jnp.abs(apart).max())
    assert jnp.allclose(back, slope[:, 2], rtol=1e-9)


@pytest.mark.stress(41)
def test_a_rod_that_starts_inside_the_floor_is_let_out(swing):
    q = jnp.array([-6.0, 0.0])
    path, total, depth = swing(q, 0 * q, jnp.array(2e-5))
    assert path.status == Status.successful
    assert depth[0] > RADIUS and depth[-1] < depth[0]
    # All that it can gain is what the overlap has stored.
    assert rise(total) < 0.01 * float(total[0])


@pytest.mark.stress(42)
@pytest.mark.slow
def test_rest_on_the_floor_stays_at_rest():
    forces = (R.Gravity([0.0, -30.0]), CONTACT, R.Damping(0.01))
    lies = R.equilibrium(ROD, forces)
    path = R.rollout(ROD, lies.q, 0 * lies.q, forces, step=5e-3, saves=4, every=50_000)
    assert lies.status == Status.successful and path.status == Status.successful
    assert R.penetration(CONTACT, R.motion(ROD, lies.q)) > 0 and float(path.time[-1]) == 1000
    assert jnp.abs(path.q - lies.q[None]).max() < 1e-6 * jnp.abs(lies.q).max()
    assert jnp.abs(path.v).max() < 1e-6


@pytest.mark.stress(43)
@pytest.mark.parametrize("speed", [0.0, 1e-12])
def test_friction_at_rest_has_finite_slopes(speed):
    q = R.equilibrium(ROD, (R.Gravity([0.0, -30.0]), CONTACT)).q

    def force(v):
        return R.total_force((CONTACT,), jnp.zeros(()), R.motion(ROD, q, v))

    at = jnp.full(2, speed)
    assert jnp.all(jnp.isfinite(force(at))) and jnp.all(jnp.isfinite(jax.jacfwd(force)(at)))


@pytest.mark.stress(19)
def test_masses_a_million_times_as_heavy():
    light, heavy = R.Link(1e-6, 1e-12), R.Link(1.0, 1e-3)
    chain = R.assembly(
        SE2(),
        first=R.Part(heavy, R.Revolute()),
        second=R.Part(light, R.Revolute(), on="first"),
    )
    q, v = jnp.array([0.3, 0.5]), jnp.array([1.0, -2.0])
    film = R.rollout(chain, q, v, (R.Gravity(),), step=1e-3, saves=20, every=10)
    assert film.status == Status.successful
    assert jnp.abs(film.v).max() < 1e3
    with pytest.raises(ValueError, match="moves and has no mass"):
        R.assembly(SE2(), only=R.Part(R.Link(0.0, 1e-3), R.Revolute()))


@pytest.mark.stress(50)
@pytest.mark.parametrize("duration, period", [(1.005, 0.01), (0.01, 1e-5)])
def test_ticks_that_do_not_divide_the_time(duration, period):
    class Count(eqx.Module):
        def start(self, t, measurement):
            return jnp.zeros(())

        def __call__(self, t, measurement, memory):
            return memory + 1, memory + 1

    plant = S.Network({"lag": S.Lag(0.1)}, {}, ("lag.a",))
    law = S.Sampled(Count(), "lag.value", "lag.a")
    film = S.simulate_sampled(plant, (law,), duration, period=period, substeps=1)
    ticks = film.time.shape[0] - 1
    assert film.status == Status.successful and abs(ticks * period - duration) <= period / 2
    assert jnp.array_equal(film["lag.a"], jnp.arange(1.0, ticks + 2))
    assert jnp.abs(film.time - period * jnp.arange(ticks + 1.0)).max() < 1e-12


@pytest.mark.stress(47)
def test_one_stiff_member_runs_apart():
    def lag(time):
        return S.Network({"lag": S.Lag(time, 1.0)}, {}, ("lag.a",))

    easy = jnp.full(8, 0.1)
    run = eqx.filter_jit(lambda times: S.simulate_batch(lag, times, 1.0, inputs={"lag.a": 0.0}))
    alone, mixed = run(easy), run(easy.at[3].set(1e-5))
    assert jnp.array_equal(mixed.stats["stiff"], jnp.arange(8) == 3)
    others = jnp.delete(jnp.arange(8), 3)
    assert jnp.array_equal(mixed.stats["steps"][others], alone.stats["steps"][others])
    assert jnp.all(mixed.status == Status.successful)
    assert jnp.abs(mixed["lag.value"][3, 1:]).max() < 1e-6
