"""Blocks and controllers against closed forms, stacks and loops against what they replace."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import contact, rod as R, sdf, systems as S
from sorojax._types import real
from sorojax.math.lie import SE2

# Gas


def vessel(**options):
    return S.Reservoir(volume=1e-4, start_pressure=50e3, **options)


def test_a_leaking_vessel_follows_the_isothermal_solution():
    film = S.simulate(S.Network({"air": vessel(leakage=0.5)}, {}), 3.0, save=4, rtol=1e-9)
    assert jnp.allclose(film["air.pressure"], 50e3 * jnp.exp(-0.5 * film.time), rtol=1e-8)


class Piston(S.AbstractBlock):
    """A volume that grows by a fifth in a second, smoothly, with its rate."""

    @property
    def inputs(self):
        return {}

    @property
    def outputs(self):
        return {"volume": S.Output("m^3"), "volume_rate": S.Output("m^3/s")}

    def initial_state(self):
        return {}

    def output(self, name, t, state, inputs):
        rate = 1e-5 * jnp.pi * jnp.sin(jnp.pi * t)
        return 1e-4 + 1e-5 * (1 - jnp.cos(jnp.pi * t)) if name == "volume" else rate

    def vector_field(self, t, state, inputs):
        return {}


def stroke(reservoir, *ports):
    wires = {f"air.{port}": f"piston.{port}" for port in ports}
    network = S.Network({"piston": Piston(), "air": reservoir}, wires)
    return S.simulate(network, 1.0, save=5, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("exponent", [1.0, 1.4])
def test_a_sealed_cylinder_keeps_absolute_p_times_v_to_the_exponent(exponent):
    air = S.Reservoir(start_pressure=50e3, exponent=exponent)
    film = stroke(air, "volume", "volume_rate")
    ratio = 1e-4 / film["piston.volume"]
    absolute = (50e3 + 101325) * ratio**exponent
    assert jnp.allclose(film["air.pressure"], absolute - 101325, rtol=1e-8)
    gauge = 50e3 * ratio[-1] ** exponent
    assert abs(film["air.pressure"][-1] / gauge - 1) > 0.3


def test_a_filtered_rate_has_the_right_sign_and_settles():
    direct = stroke(S.Reservoir(start_pressure=50e3), "volume", "volume_rate")
    errors = []
    for bandwidth in (100.0, 1000.0):
        air = S.Reservoir(start_pressure=50e3, bandwidth=bandwidth, start_volume=1e-4)
        film = stroke(air, "volume")
        errors.append(float(jnp.abs(film["air.pressure"] - direct["air.pressure"]).max()))
    assert errors[0] < 1500 and 8 < errors[0] / errors[1] < 12
    with pytest.raises(ValueError, match="air.volume_rate"):
        stroke(S.Reservoir(), "volume")
    with pytest.raises(ValueError, match="start_volume"):
        S.Reservoir(bandwidth=10.0)


def test_a_valve_chokes_reverses_and_lags():
    valve = S.Valve(1e-9, 0.3, lag=0.01)
    state = {"opening": jnp.array(1.0), "late": jnp.zeros(0)}

    def flow(up, down):
        return valve.output(
            "mass_flow", 0.0, state, {"upstream": real(up), "downstream": real(down)}
        )

    choked = 1e5 / (287.05 * 293.15) * 1e-9 * (300e3 + 101325)
    assert jnp.isclose(flow(300e3, 0.0), choked, rtol=1e-12)
    ratio = (200e3 + 101325) / (300e3 + 101325)
    share = np.sqrt(1 - ((ratio - 0.3) / 0.7) ** 2)
    assert jnp.isclose(flow(300e3, 200e3), choked * share, rtol=1e-12)
    assert jnp.isclose(flow(200e3, 300e3), -choked * share, rtol=1e-12)
    assert flow(1e5, 1e5) == 0 and jnp.isfinite(jax.grad(flow)(1e5, 1e5))
    late = S.Valve(1e-9, lag=1e-3, delay=0.1, stages=20)
    network = S.Network({"v": late}, {}, ("v.command", "v.upstream"))
    film = S.simulate(network, 0.2, save=21, inputs={"v.command": 1.0, "v.upstream": 1e5})
    half = jnp.interp(0.5, film["v.opening"], film.time)
    assert jnp.isclose(half, 0.1, rtol=0.05) and film["v.opening"][5] < 0.02


def test_sensors_repeat_their_noise_and_have_the_stated_spread():
    sensor = S.Sensor(0.1, 1e-3, key=jax.random.key(1), offset=0.5)

    def read(t):
        return sensor.output("value", t, {}, {"a": jnp.zeros(())})

    values = jax.vmap(read)(1e-3 * jnp.arange(4000.0))
    assert jnp.isclose(values.mean(), 0.5, atol=0.01)
    assert jnp.isclose(values.std(), 0.1, rtol=0.05)
    assert read(jnp.array(2e-3)) == values[2] == read(jnp.array(2.9e-3))


# Stacks and loops


def fingers(count):
    def one(length):
        body = R.rod(
            SE2(),
            R.chebyshev(kappa_z=2),
            R.circle(6e-3),
            length=length,
            young_modulus=1e6,
            poisson_ratio=0.4,
            density=1100.0,
            nodes=4,
        )
        return S.RodBody(body, (R.Gravity(), R.Damping(0.02)), driven=True)

    return [one(0.07 + 0.01 * k) for k in range(count)]


def test_a_stack_equals_its_blocks_and_is_traced_once():
    blocks = fingers(3)
    stacked = S.stack(blocks)
    state = jax.tree.map(lambda x: x + 1.0, stacked.initial_state())
    effort = {"effort": 1e-4 * jnp.arange(6.0).reshape(3, 2)}
    together = stacked.vector_field(jnp.array(0.0), state, effort)
    for k, block in enumerate(blocks):
        own = jax.tree.map(lambda x, k=k: x[k], (state, effort))
        alone = block.vector_field(jnp.array(0.0), *own)
        same = jax.tree.map(
            lambda a, b, k=k: jnp.allclose(a[k], b, rtol=1e-12), together, alone
        )
        assert jax.tree.all(same)
    assert stacked.outputs["tip_position"] == S.Output("m", (3, 2))
    network = S.Network({"f": stacked}, {})
    sizes = [
        len(
            jax.make_jaxpr(lambda x, n=n: n.vector_field(0.0, x, {"effort": 0 * x["v"]}))(
                n.initial_state()
            ).eqns
        )
        for n in (S.stack(blocks[:2]), stacked)
    ]
    assert sizes[0] == sizes[1] and network.inputs == {}
    with pytest.raises(ValueError, match="2 structures"):
        S.stack([blocks[0], S.Reservoir()])


def looped(gain, **options):
    """y = gain tanh(y + u) + u, an algebraic loop of two blocks."""
    squash = S.Function(Squash(gain), ("a",))
    blocks = {"sum": S.sum_of([1.0, 1.0]), "law": squash, "lag": S.Lag(0.1)}
    wires = {"sum.a": "law.value", "law.a": "sum.value", "lag.a": "sum.value"}
    return S.Network(blocks, wires, ("sum.b",), **options)


class Squash(eqx.Module):
    gain: jax.Array = eqx.field(converter=real)

    def __call__(self, x):
        return self.gain * jnp.tanh(x)


def test_an_algebraic_loop_is_solved_and_differentiated_on_request():
    with pytest.raises(ValueError, match="solve_loops"):
        looped(0.5)

    def total(gain):
        network = looped(gain, solve_loops=True)
        return network.output(
            "sum.value", jnp.array(0.0), network.initial_state(), {"sum.b": jnp.array(0.3)}
        )

    gain = jnp.array(0.5)
    x = total(gain)
    assert jnp.isclose(x, gain * jnp.tanh(x) + 0.3, rtol=1e-14)
    exact = jnp.tanh(x) / (1 - gain * (1 - jnp.tanh(x) ** 2))
    assert jnp.isclose(jax.grad(total)(gain), exact, rtol=1e-12)
    assert jnp.isclose(jax.jacfwd(total)(gain), exact, rtol=1e-12)
    film = S.simulate(looped(0.5, solve_loops=True), 0.5, save=3, inputs={"sum.b": 0.3})
    assert jnp.isclose(film["lag.value"][-1], x * (1 - np.exp(-5)), rtol=1e-4)


def test_gains_carry_units():
    blocks = {"g": S.gain(2.0, unit="Pa", input_unit="rad"), "l": S.Lag(1.0, unit="rad")}
    with pytest.raises(ValueError, match="cannot drive"):
        S.Network(blocks, {"l.a": "g.value", "g.a": "l.value"})


def test_refused_signals_are_told_what_takes_them():
    two = S.Source(S.Constant([1.0, 2.0]), unit="rad")
    pid = S.PID(1.0, reference=S.Constant(0.0), command_unit="N")
    with pytest.raises(ValueError, match="systems.stack"):
        S.Network({"two": two, "pid": pid}, {"pid.measurement": "two.value"})
    both = S.Network({"two": two, "pid": S.stack([pid, pid])}, {"pid.measurement": "two.value"})
    assert S.simulate(both, 0.1, save=2)["pid.command"].shape == (2, 2)
    with pytest.raises(TypeError, match=r"class Mine\(AbstractReference\) with __call__"):
        S.Source(lambda t: t)  # pyright: ignore[reportArgumentType]


# Rigid bodies


def test_a_racket_flips_and_keeps_its_momentum():
    body = S.RigidBody(0.3, [1e-3, 2e-3, 3e-3], angular_velocity=[1e-3, 10.0, 1e-3])
    film = S.simulate(S.Network({"b": body}, {}), 30.0, save=1501, rtol=1e-11, atol=1e-13)
    momentum, energy = np.asarray(film["b.angular_momentum"]), film["b.energy"]
    assert np.abs(momentum - momentum[0]).max() < 1e-10 * np.abs(momentum).max()
    assert jnp.abs(energy / energy[0] - 1).max() < 1e-8
    q = film.state["b"]["q"][:, 3:]
    axis = 1 - 2 * (q[:, 1] ** 2 + q[:, 3] ** 2) / jnp.sum(q**2, axis=1)  # body y on world y
    flips = jnp.sum(jnp.diff(jnp.sign(axis)) != 0)
    assert axis.min() < -0.999 and axis.max() > 0.999 and flips >= 8


@pytest.mark.stress(42, 49)
def test_a_ball_comes_to_rest_on_a_floor():
    floor = sdf.HalfSpace([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    touch = S.Touch(floor, [[0.0, 0.0, -0.02]], [1e-4], contact.Penalty(1e8, 1e-5), 3e4)
    body = S.RigidBody(
        0.1, [1e-5] * 3, [0.0, 0.0, 0.025], gravity=[0.0, 0.0, -9.81], touch=(touch,)
    )
    film = S.simulate(S.Network({"b": body}, {}), 1.0, save=11)
    depth = 0.1 * 9.81 / (1e8 * 1e-4) + 1e-5 / 2
    assert jnp.isclose(film["b.position"][-1, 2], 0.02 - depth, rtol=0, atol=1e-7)
    assert film["b.energy"][-1] < 1e-9


# Controllers that know the model

REST = R.rod(
    SE2(),
    R.chebyshev(kappa_z=3),
    R.circle(6e-3),
    length=0.1,
    young_modulus=2e5,
    poisson_ratio=0.4,
    density=1100.0,
    nodes=6,
)
FORCES = (R.Gravity(), R.Damping(0.02))
GOAL = S.Constant([4.0, -2.0, 1.0])
STEADY = S.Constant([0.09, 0.02])
M0 = float(R.mass_matrix(REST, jnp.zeros(3))[0, 0])


def closed_loop(law, duration=0.5, **options):
    body = S.RodBody(REST, FORCES, driven=True, **options)
    wires = {"body.effort": "law.effort", "law.q": "body.q", "law.v": "body.v"}
    network = S.Network({"body": body, "law": law}, wires)
    return S.simulate(network, duration, save=6, step=5e-4, solver=S.Rosenbrock2(True))


def test_contact_turns_a_body_about_its_centre():
    """A floor below the left end pushes it up: the right end goes down."""
    floor = sdf.HalfSpace([0.0, 0.0, -0.02], [0.0, 0.0, 1.0])
    touch = S.Touch(floor, [[-0.03, 0.01, -0.0201]], [1e-4], contact.Penalty(1e8, 1e-5))
    body = S.RigidBody(0.1, [1e-4, 1e-4, 1e-4], touch=(touch,))
    none = {"force": jnp.zeros(3), "torque": jnp.zeros(3)}
    turn, push = jnp.split(body.vector_field(0.0, body.initial_state(), none)["p"], 2)
    assert push[2] > 0 and jnp.allclose(push[:2], 0.0)
    assert jnp.allclose(turn, jnp.cross(jnp.array([-0.03, 0.01, -0.0201]), push), rtol=1e-9)


def test_computed_torque_makes_errors_decay_as_asked():
    film = closed_loop(S.ComputedTorque(REST, FORCES, GOAL, 400.0, 40.0))
    decay = (1 + 20 * film.time) * jnp.exp(-20 * film.time)  # critically damped
    error = np.asarray(film["body.q"]) - np.asarray(GOAL.value)
    expected = -np.asarray(decay)[:, None] * np.asarray(GOAL.value)
    assert np.allclose(error, expected, rtol=0, atol=2e-4)


@pytest.mark.parametrize(
    "law",
    [
        S.Compensation(REST, (R.Gravity(),), GOAL, 500 * M0, 10 * M0),
        S.FeedForward(REST, FORCES, GOAL),
    ],
)
def test_the_static_laws_come_to_rest_at_the_goal(law):
    film = closed_loop(law, 4.0)
    assert jnp.allclose(film["body.q"][-1], GOAL.value, rtol=0, atol=5e-3)


def test_energy_shaping_comes_to_rest_at_the_least_wanted_energy():
    wanted = S.TipSpring(REST, STEADY.value, 2.0, 1e-5)
    film = closed_loop(S.EnergyShaping(REST, (R.Gravity(),), wanted, 2e-6), 6.0)
    slope = jax.grad(wanted)(film["body.q"][-1])
    assert jnp.abs(slope).max() < 1e-3 * jnp.abs(jax.grad(wanted)(jnp.zeros(3))).max()


def test_cartesian_impedance_gives_the_tip_its_spring():
    """Pushed at the tip, it yields by force / stiffness, wherever the other modes are."""
    law = S.CartesianImpedance(REST, FORCES, STEADY, 20.0, 2.0, 30.0)
    pushed = (*FORCES, R.TipWrench([0.0, 0.0, 0.04]))
    body = S.RodBody(REST, pushed, driven=True, q=[3.0, 1.0, 0.5])
    wires = {"body.effort": "law.effort", "law.q": "body.q", "law.v": "body.v"}
    network = S.Network({"body": body, "law": law}, wires)
    film = S.simulate(network, 3.0, save=4, step=1e-3, solver=S.Rosenbrock2(True))
    moved = film["body.tip_position"][-1] - STEADY.value
    assert jnp.linalg.norm(moved) > 1e-3
    assert jnp.isclose(jnp.linalg.norm(moved), 0.04 / 20.0, rtol=1e-2)


def test_a_law_is_the_same_wired_and_sampled():
    law = S.ComputedTorque(REST, FORCES[:1], GOAL, 400.0, 40.0)  # keeps the damping there is
    plant = S.Network({"b": S.RodBody(REST, FORCES, driven=True)}, {}, ("b.effort",))
    loop = S.Sampled(law, ("b.q", "b.v"), "b.effort")
    film = S.simulate_sampled(
        plant, loop, 0.5, period=1e-3, substeps=1, method=S.Rosenbrock2(refresh=True)
    )
    wired = closed_loop(law)
    assert jnp.allclose(film["b.q"][-1], wired["body.q"][-1], rtol=0, atol=1e-2)
