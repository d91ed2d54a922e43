"""Blocks, networks, pneumatics, control and their simulation."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from sorojax import replace, rod as R, systems as S
from sorojax._types import real
from sorojax.math.lie import SE2, SE3
from sorojax.math.status import Status

WIRES = {
    "body.pressure": "air.pressure",
    "air.volume": "body.volume",
    "air.volume_rate": "body.volume_rate",
    "air.mass_flow": "valve.mass_flow",
    "valve.pressure": "air.pressure",
    "valve.setpoint": "pid.command",
    "pid.measurement": "body.tip_angle",
}


class Bellows(R.AbstractChamber):
    """A chamber whose volume is affine in q."""

    rest: jax.Array = eqx.field(converter=real)
    slope: jax.Array = eqx.field(converter=real)
    ports: tuple[int, ...] = eqx.field(static=True, default=())

    def volume(self, q):
        return self.rest + self.slope @ q


class StretchyBellows(R.AbstractPressureMap):
    """The same chamber with walls that give way in proportion to the pressure."""

    rigid: Bellows
    compliance: jax.Array = eqx.field(converter=real)
    ports: tuple[int, ...] = eqx.field(static=True, default=())

    def coenergy(self, q, pressure):
        return self.rigid.coenergy(q, pressure) + self.compliance * pressure**2 / 2


class Breath(S.AbstractBlock):
    """A volume that follows V = V0 (1 + a sin(w t)), with its exact rate."""

    rest: jax.Array = eqx.field(converter=real, default=1e-5)

    @property
    def inputs(self):
        return {}

    @property
    def outputs(self):
        return {"volume": S.Output("m^3"), "volume_rate": S.Output("m^3/s")}

    def initial_state(self):
        return {}

    def output(self, name, t, state, inputs):
        def volume(t):
            return self.rest * (1 + 0.5 * jnp.sin(6 * t))

        return volume(t) if name == "volume" else jax.grad(volume)(t)

    def vector_field(self, t, state, inputs):
        return {}


def make_body(**options):
    basis = R.chebyshev(kappa_z=2)
    rod = R.rod(
        SE2(),
        basis,
        R.rectangle(25e-3, 20e-3),
        length=0.117,
        young_modulus=2e5,
        poisson_ratio=0.49,
        density=1070.0,
    )
    chamber = Bellows(1.5e-5, [2e-7, 5e-8])
    return S.RodBody(rod, (chamber, R.Gravity(), R.Damping(0.02)), **options)


def make_loop():
    reference = S.SmoothRamp([0.0, 0.3], [0.0, 0.3])
    pid = S.PID(3e4, 2e5, 5e2, reference=reference, low=0.0, high=4e4)
    blocks = {
        "body": make_body(),
        "air": S.Reservoir(),
        "valve": S.Regulator(1e-8, 1e-7, max_flow=1e-4),
        "pid": pid,
    }
    return S.Network(blocks, WIRES)


@pytest.fixture(scope="module")
def loop():
    return make_loop()


# Closed forms


def test_a_sealed_reservoir_keeps_absolute_pressure_times_volume():
    wires = {"air.volume": "lung.volume", "air.volume_rate": "lung.volume_rate"}
    air = S.Reservoir(start_pressure=20e3)
    film = S.simulate(S.Network({"lung": Breath(), "air": air}, wires), 1.0, rtol=1e-9)
    absolute = film["air.pressure"] + 101325.0
    product = absolute * film["lung.volume"]
    assert jnp.allclose(product, 121325.0 * 1e-5, rtol=1e-7)
    gauge = film["air.pressure"] * film["lung.volume"]  # what a gauge law would keep
    assert jnp.abs(gauge / gauge[0] - 1).max() > 0.5


def test_gas_sealed_behind_yielding_walls_keeps_absolute_pressure_times_volume():
    body = make_body()
    rigid = body.forces[0]
    walls = StretchyBellows(rigid, 2e-10)
    body = S.RodBody(
        body.rod,
        (walls, *body.forces[1:]),
        q=jnp.array([20.0, 5.0, 0.0])[: body.rod.basis.num_dof],
    )
    ports = ("volume", "volume_rate", "compliance")
    wires = {f"air.{port}": f"body.{port}" for port in ports} | {
        "body.pressure": "air.pressure"
    }
    network = S.Network({"body": body, "air": S.Reservoir(start_pressure=20e3)}, wires)
    film = S.simulate(network, 0.2, rtol=1e-9, atol=1e-12)
    product = (film["air.pressure"] + 101325.0) * film["body.volume"]
    assert jnp.ptp(film["air.pressure"]) > 10.0
    assert jnp.allclose(product, product[0], rtol=1e-7)


@pytest.mark.versions
def test_mass_flow_fills_a_rigid_volume_linearly():
    source = S.Source(S.Constant(1e-6), unit="kg/s")
    wires = {"air.mass_flow": "pump.value"}
    blocks = {"pump": source, "air": S.Reservoir(volume=1e-4)}
    film = S.simulate(S.Network(blocks, wires), 2.0, save=3)
    expected = 287.05 * 293.15 * 1e-6 * film.time / 1e-4
    assert jnp.allclose(film["air.pressure"], expected, rtol=1e-9, atol=1e-6)


def test_a_saturated_regulator_does_not_wind_up():
    valve = S.Regulator(1e-8, 1e-7, max_flow=1e-6)
    target = S.Source(S.Constant(3e3), unit="Pa")
    wires = {
        "valve.setpoint": "target.value",
        "valve.pressure": "air.pressure",
        "air.mass_flow": "valve.mass_flow",
    }
    blocks = {"valve": valve, "target": target, "air": S.Reservoir(volume=1e-4)}
    film = S.simulate(S.Network(blocks, wires), 10.0)
    assert jnp.isclose(film["valve.mass_flow"][1], 1e-6)
    assert film["air.pressure"].max() < 1.15 * 3e3
    assert jnp.isclose(film["air.pressure"][-1], 3e3, rtol=1e-3)


# Coherence


def monolith(network, t, state):
    """The closed loop of `make_loop`, written by hand."""
    body, air, valve, pid = (network.blocks[k] for k in ("body", "air", "valve", "pid"))
    q, v = state["body"]["q"], state["body"]["v"]
    chamber = body.forces[0]
    volume, volume_rate = chamber.rest + chamber.slope @ q, chamber.slope @ v
    gauge = state["air"] - air.atmosphere
    force = (R.Pressurised(chamber, gauge), *body.forces[1:])
    acceleration = R.forward_dynamics(body.rod, q, v, force)
    angle = R.tip_angle(R.motion(body.rod, q))
    error = pid.reference(t) - angle
    rate = (angle - state["pid"]["filtered"]) / pid.filter_time
    wanted = pid.proportional * error + state["pid"]["integral"] - pid.derivative * rate
    setpoint = jnp.clip(wanted, pid.low, pid.high)
    growth = pid.integral_gain * error + (setpoint - wanted) / pid.tracking_time
    miss = setpoint - gauge
    flow = valve.proportional * miss + state["valve"]
    limited = jnp.clip(flow, -valve.max_flow, valve.max_flow)
    supply = air.gas_constant * air.temperature * limited
    return {
        "body": {"q": v, "v": acceleration},
        "air": (supply - state["air"] * volume_rate) / volume,
        "valve": valve.integral_gain * (miss + (limited - flow) / valve.proportional),
        "pid": {"integral": growth, "filtered": rate},
    }


def test_a_network_equals_a_hand_written_monolith(loop):
    state = loop.initial_state()
    state["body"] = {"q": jnp.array([1.0, -2.0]), "v": jnp.array([5.0, 3.0])}
    state["pid"] = {"integral": jnp.array(300.0), "filtered": jnp.array(0.02)}
    t = jnp.array(0.1)
    wired = eqx.filter_jit(loop.vector_field)(t, state)
    written = eqx.filter_jit(monolith)(loop, t, state)
    assert jax.tree.structure(wired) == jax.tree.structure(written)
    close = jax.tree.map(lambda a, b: jnp.allclose(a, b, rtol=1e-14, atol=0), wired, written)
    assert all(jax.tree.leaves(close))


def test_the_loop_reaches_its_reference_adaptively_and_by_fixed_steps(loop):
    film = S.simulate(loop, 0.5, save=11)
    fixed = S.simulate(loop, 0.5, save=11, step=2.5e-4)
    assert film.status == Status.successful and int(film.stats["steps"]) > 10
    assert jnp.allclose(film["body.tip_angle"], fixed["body.tip_angle"], rtol=0, atol=1e-5)
    assert jnp.isclose(film["body.tip_angle"][-1], 0.3, atol=0.1)
    assert film.state["body"]["q"].shape == (11, 2)


@pytest.mark.versions
def test_a_network_of_networks_and_exposed_inputs():
    ports = ("air.volume", "air.volume_rate", "air.mass_flow")
    inner = S.Network({"air": S.Reservoir()}, {}, ports)
    tank = S.Source(S.Constant(1e-4), unit="m^3")
    still = S.Source(S.Constant(0.0), unit="m^3/s")
    wires = {"gas.air.volume": "tank.value", "gas.air.volume_rate": "still.value"}
    blocks = {"gas": inner, "tank": tank, "still": still}
    outer = S.Network(blocks, wires, ("gas.air.mass_flow",))
    pulse = {"gas.air.mass_flow": S.Sine(1e-6, 1.0)}
    film = S.simulate(outer, 1.0, inputs=pulse, save=3, rtol=1e-9)
    half = 287.05 * 293.15 * 1e-6 / 1e-4 / jnp.pi
    expected = jnp.array([0.0, float(half), 0.0])
    assert jnp.allclose(film["gas.air.pressure"], expected, rtol=0, atol=1e-3)


def test_a_sampled_pid_follows_the_continuous_one():
    pid = S.PID(2.0, 3.0, 0.05, reference=S.Constant(1.0), low=-1.0, high=1.5)

    def measured(t):
        return 0.8 * jnp.sin(3 * t)

    def field(t, state, _):
        return pid.vector_field(t, state, {"measurement": measured(t)})

    end, h = 1.0, 1e-3
    final = dfx.diffeqsolve(
        dfx.ODETerm(field), dfx.Tsit5(), 0.0, end, 1e-3, pid.initial_state(), max_steps=2000
    ).ys
    final = jax.tree.map(lambda x: x[-1], final)
    continuous = pid.output("command", end, final, {"measurement": measured(end)})

    def tick(memory, t):
        command, memory = pid(t, measured(t), memory)
        return memory, command

    start = pid.start(jnp.array(0.0), measured(0.0))
    _, commands = jax.lax.scan(tick, start, jnp.linspace(h, end, 1000))
    assert jnp.isclose(commands[-1], continuous, atol=2e-2)
    assert commands.max() <= 1.5


def test_one_controller_runs_wired_and_sampled(loop):
    pid = loop.blocks["pid"]
    blocks = {name: loop.blocks[name] for name in ("body", "air", "valve")}
    wires = {k: v for k, v in WIRES.items() if "pid" not in k + v}
    plant = S.Network(blocks, wires, ("valve.setpoint",))
    ports = dict(measurement="body.tip_angle", command="valve.setpoint")
    sampled = S.simulate_sampled(plant, pid, 0.5, period=2e-3, **ports)
    wired = S.simulate(loop, 0.5, save=11)
    assert sampled.status == Status.successful
    assert jnp.isclose(sampled["body.tip_angle"][-1], wired["body.tip_angle"][-1], atol=3e-3)
    assert jnp.array_equal(sampled["valve.setpoint"] >= 0, jnp.ones(251, bool))
    with pytest.raises(ValueError, match="not an exposed input"):
        S.simulate_sampled(loop, pid, 0.5, period=2e-3, **ports)


def test_a_spatial_body_swings_like_its_rollout():
    rod = R.rod(
        SE3(),
        R.chebyshev(kappa_y=1),
        R.circle(6e-3),
        length=0.08,
        young_modulus=1e6,
        poisson_ratio=0.3,
        density=2000.0,
    )
    forces = (R.Gravity(), R.Damping(0.01))
    film = S.simulate(S.Network({"body": S.RodBody(rod, forces)}, {}), 0.1, save=3, rtol=1e-8)
    path = R.rollout(rod, jnp.zeros(1), jnp.zeros(1), forces, step=2e-4, saves=2, every=250)
    assert jnp.allclose(film["body.q"], path.q, rtol=0, atol=1e-3 * jnp.abs(path.q).max())


# Derivatives and cost


@pytest.mark.versions
def test_a_simulation_is_differentiable():
    network = S.Network({"body": make_body()}, {}, ("body.pressure",))

    def tip(pressure, adjoint=None, step=None):
        film = S.simulate(
            network,
            0.05,
            inputs={"body.pressure": pressure},
            save=2,
            adjoint=adjoint,
            step=step,
            atol=1e-10,
        )
        return film["body.tip_angle"][-1]

    at = jnp.array(5e3)
    reverse = jax.grad(lambda p: tip(p, step=5e-4))(at)
    forward = jax.jacfwd(lambda p: tip(p, dfx.ForwardMode()))(at)
    assert jnp.isclose(reverse, forward, rtol=1e-5)


@pytest.mark.slow
def test_an_adaptive_run_is_differentiable_backwards():
    network = S.Network({"air": S.Reservoir(volume=1e-4)}, {}, ("air.mass_flow",))

    def pressure(flow):
        inputs = {"air.mass_flow": flow}
        return S.simulate(network, 1.0, inputs=inputs, save=2)["air.pressure"][-1]

    slope = jax.grad(pressure)(jnp.array(1e-6))
    assert jnp.isclose(slope, 287.05 * 293.15 / 1e-4, rtol=1e-9)


@pytest.mark.versions
def test_numbers_do_not_retrace(loop):
    def rate(network, state):
        return network.vector_field(jnp.array(0.0), state)

    once = eqx.filter_jit(eqx.debug.assert_max_traces(rate, max_traces=1))
    for gain in (1e4, 2e4, 3):
        edited = replace(loop, lambda n: n.blocks["pid"].proportional, gain)
        once(edited, edited.initial_state())


def test_a_body_without_a_chamber_has_no_pressure_port():
    body = make_body()
    plain = S.RodBody(body.rod, body.forces[1:])
    assert plain.inputs == {} and "volume" not in plain.outputs
    assert body.outputs["volume"] == S.Output("m^3", (), frozenset({"pressure"}))
    assert "pressure" in body.inputs


# Bad input


def test_wiring_errors_name_the_remedy():
    body, air, valve = make_body(), S.Reservoir(), S.Regulator(1e-8)
    blocks = {"body": body, "air": air, "valve": valve}
    with pytest.raises(ValueError, match="no output `air.presure`"):
        S.Network(blocks, {"body.pressure": "air.presure"})
    with pytest.raises(ValueError, match="cannot drive `body.pressure`"):
        S.Network(blocks, {"body.pressure": "valve.mass_flow"})
    with pytest.raises(ValueError, match=r"`air.volume` \[m\^3\] is not connected"):
        S.Network({"air": air}, {})
    with pytest.raises(ValueError, match="one driver"):
        S.Network(blocks, {"air.volume": "body.volume"}, ("air.volume",))
    with pytest.raises(ValueError, match="contains a dot"):
        S.Network({"a.b": air}, {})
    with pytest.raises(ValueError, match="at most one"):
        S.RodBody(body.rod, (body.forces[0], body.forces[0]))
    with pytest.raises(ValueError, match="low"):
        S.PID(1.0, low=1.0, high=0.0)


def test_an_algebraic_loop_is_listed():
    gain = S.PID(1.0, measurement_unit="Pa", reference=S.Constant(0.0))
    wires = {"a.measurement": "b.command", "b.measurement": "a.command"}
    with pytest.raises(
        ValueError,
        match=r"b.command -> a.command -> b.command|a.command -> b.command -> a.command",
    ):
        S.Network({"a": gain, "b": gain}, wires)


def test_a_failed_run_says_so():
    wires = {"air.volume": "lung.volume", "air.volume_rate": "lung.volume_rate"}
    loop = S.Network({"lung": Breath(), "air": S.Reservoir()}, wires)
    with pytest.raises(RuntimeError, match="step limit"):
        S.simulate(loop, 9.0, save=3, max_steps=4)
    film = S.simulate(loop, 9.0, save=3, max_steps=4, throw=False)
    assert film.status == Status.max_steps


def test_outputs_that_nothing_reads_are_not_traced():
    class Shy(Breath):
        def output(self, name, t, state, inputs):
            if name == "volume_rate":
                raise AssertionError("nobody asked")
            return super().output(name, t, state, inputs)

    network = S.Network({"breath": Shy()}, wires={})
    state = network.initial_state()
    S.network.rates_of(network, jnp.zeros(()), state, {}, ("breath",))
    assert float(network.output("breath.volume", jnp.zeros(()), state, {})) > 0
    with pytest.raises(AssertionError, match="nobody asked"):
        S.outputs(network, jnp.zeros(()), state)
