"""A closed loop as a function of its gains, material and geometry; a known attractor."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import rod as R, systems as S
from sorojax._types import real
from sorojax.math.lie import SE2

WIRES = {
    "body.pressure": "air.pressure",
    "air.volume": "body.volume",
    "air.volume_rate": "body.volume_rate",
    "air.mass_flow": "valve.mass_flow",
    "valve.pressure": "air.pressure",
    "valve.setpoint": "pid.command",
    "pid.measurement": "body.tip_angle",
}
NOMINAL = jnp.array([-2e4, 2e5, 0.12])  # gain [Pa/rad], modulus [Pa], length [m]


def loop(parameters):
    gain, modulus, length = parameters
    body = R.rod(
        SE2(),
        R.chebyshev(kappa_z=2),
        R.rectangle(25e-3, 12e-3),
        length=length,
        young_modulus=modulus,
        poisson_ratio=0.49,
        density=1070.0,
        nodes=4,
    )
    chamber = R.thread_chambers(body, R.Straight((4e-3,)), 1e-4)
    blocks = {
        "body": S.RodBody(body, (chamber, R.Gravity(), R.Damping(0.01))),
        "air": S.Reservoir(dead_volume=2e-6),
        "valve": S.Regulator(1e-8, 2e-8),
        "pid": S.PID(gain, -2e4, -1e2, reference=S.Constant(-0.3)),
    }
    return S.Network(blocks, WIRES)


def cost(scale):
    """Mean square error of the tip angle in a fifth of a second, parameters relative."""
    film = S.simulate(loop(scale * NOMINAL), 0.2, save=5, step=5e-4)
    return jnp.mean((film["body.tip_angle"] + 0.3) ** 2)


@pytest.mark.slow
def test_gradients_of_a_closed_loop_agree_with_differences():
    one, eye = jnp.ones(3), jnp.eye(3)
    both = jax.jit(jax.value_and_grad(cost))  # one program for values and slopes
    reverse = both(one)[1]
    forward = jax.jit(jax.jacfwd(cost))(one)
    assert jnp.allclose(reverse, forward, rtol=1e-9)
    h = 2e-3
    steps = [both(one + k * h * row)[0] for row in eye for k in (-2, -1, 1, 2)]
    weights = np.array([1, -8, 8, -1]) / (12 * h)  # centred, order 4
    differences = np.asarray(steps).reshape(3, 4) @ weights
    scale = np.abs(differences).max()
    assert np.all(np.abs(differences) > 1e-3 * scale)
    assert np.allclose(reverse, differences, rtol=1e-6, atol=1e-7 * scale)


class Duffing(S.AbstractBlock):
    """x'' + delta x' - x + x^3 = gamma cos(omega t)."""

    gamma: jax.Array = eqx.field(converter=real)
    delta: jax.Array = eqx.field(converter=real, default=0.3)
    omega: jax.Array = eqx.field(converter=real, default=1.2)

    @property
    def inputs(self):
        return {}

    @property
    def outputs(self):
        return {"x": S.Output(None)}

    def initial_state(self):
        return {"q": real(1.0), "v": real(0.0)}

    def output(self, name, t, state, inputs):
        return state["q"]

    def vector_field(self, t, state, inputs):
        q, v = state["q"], state["v"]
        push = self.gamma * jnp.cos(self.omega * t)
        return {"q": v, "v": push - self.delta * v + q - q**3}


@pytest.mark.parametrize("gamma, periods", [(0.20, 1), (0.28, 2), (0.29, 4), (0.37, 5)])
def test_the_duffing_attractor_has_its_period(gamma, periods):
    """The windows of the classic bifurcation diagram, seen once per period of the forcing."""
    every, rounds = 2 * np.pi / 1.2, 200
    network = S.Network({"d": Duffing(gamma)}, {})
    film = S.simulate(network, every * rounds, save=rounds + 1, rtol=1e-9, atol=1e-11)
    seen = np.asarray(film["d.x"])[-40:]
    returns = [np.abs(seen[k:] - seen[:-k]).max() for k in (1, 2, 3, 4, 5)]
    assert returns[periods - 1] < 1e-4
    assert all(returns[k - 1] > 1e-3 for k in range(1, periods))


def test_the_attractor_is_chaotic_between_the_windows():
    every, rounds = 2 * np.pi / 1.2, 200
    film = S.simulate(
        S.Network({"d": Duffing(0.5)}, {}),
        every * rounds,
        save=rounds + 1,
        rtol=1e-9,
        atol=1e-11,
    )
    seen = np.asarray(film["d.x"])[-60:]
    assert all(np.abs(seen[k:] - seen[:-k]).max() > 0.1 for k in range(1, 11))
    assert np.abs(film["d.x"]).max() < 2.0 and seen.min() < 0 < seen.max()


def test_dense_output_is_the_motion_between_the_saved_instants():
    film = S.simulate(
        S.Network({"d": Duffing(0.2)}, {}), 5.0, save=2, dense=True, max_steps=400, rtol=1e-8
    )
    fine = S.simulate(
        S.Network({"d": Duffing(0.2)}, {}), 5.0, save=6, rtol=1e-10, adjoint=dfx.ForwardMode()
    )
    for k in (1, 3):
        there = S.state_at(film, fine.time[k])["d"]["q"]
        assert jnp.isclose(there, fine["d.x"][k], rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="dense=True"):
        S.state_at(fine, 1.0)


# Reverse mode of adaptive runs


class Spring(S.AbstractBlock):
    """A driven oscillator with a table of numbers that never change."""

    stiffness: jnp.ndarray
    start: jnp.ndarray
    inputs = {}
    outputs = {}

    def output(self, name, t, state, inputs):
        raise AssertionError(name)

    def initial_state(self):
        return self.start

    def vector_field(self, t, state, inputs):
        q, v = state
        return jnp.stack([v, jnp.cos(t) - jnp.sum(jnp.sqrt(self.stiffness)) * q**3 - 0.2 * v])


def ends_of(numbers, solver, adjoint=None, save=40, **options):
    """Sum of squares of the path and its end, of a run with many instants in a step."""
    spring = Spring(numbers["stiffness"], numbers["start"])
    film = S.simulate(
        S.Network({"spring": spring}, {}),
        numbers["duration"],
        save=save,
        solver=solver,
        adjoint=adjoint,
        **options,
    )
    return jnp.sum(film.state["spring"] ** 2) + film.state["spring"][-1, 0]


NUMBERS = {
    "stiffness": jnp.array([1.0, 2.0]),
    "start": jnp.array([0.5, 0.1]),
    "duration": jnp.array(3.0),
}


@pytest.mark.parametrize(
    "solver", [S.Tsit5(), pytest.param(S.Rodas4(), marks=pytest.mark.slow)]
)
def test_the_replayed_run_has_the_derivative_of_the_run(solver):
    """By start, constants and duration; few checkpoints, so that most states are computed
    again; steps are chosen by the tolerance, so that differences carry its error."""
    few = {"max_steps": 20_000, "rtol": 1e-8, "atol": 1e-10}
    found = jax.grad(ends_of)(NUMBERS, solver, **few)
    forward = jax.jacfwd(ends_of)(NUMBERS, solver, dfx.ForwardMode(), **few)
    for name, slope in found.items():
        np.testing.assert_allclose(slope, forward[name], rtol=1e-9, atol=1e-11)
    h = 1e-4
    late, early = ({**NUMBERS, "duration": 3.0 + s * h} for s in (1, -1))
    tight = {"rtol": 1e-11, "atol": 1e-12}
    by_hand = (ends_of(late, solver, **tight) - ends_of(early, solver, **tight)) / (2 * h)
    np.testing.assert_allclose(found["duration"], by_hand, rtol=1e-5)


def test_a_run_that_fails_has_finite_derivatives_in_lanes_too():
    numbers = jax.tree.map(lambda x: jnp.stack([x, x]), NUMBERS)
    numbers["stiffness"] = numbers["stiffness"].at[1].multiply(1e12)  # too many steps

    def total(numbers):
        one = lambda n: ends_of(n, S.Tsit5(), max_steps=60, throw=False)  # noqa: E731
        return jnp.sum(jax.vmap(one)(numbers))

    found = jax.grad(total)(numbers)
    alone = jax.grad(ends_of)(NUMBERS, S.Tsit5(), max_steps=60)
    for name, slope in found.items():
        assert jnp.all(jnp.isfinite(slope)), name
        np.testing.assert_allclose(slope[0], alone[name], rtol=1e-9)


def test_an_adaptive_run_has_second_derivatives():
    def slope(stiffness):
        run = {**NUMBERS, "stiffness": stiffness}
        return jax.grad(ends_of)(run, S.Tsit5(), rtol=1e-9, atol=1e-11)["stiffness"]

    at, h = NUMBERS["stiffness"], 1e-4
    second = jax.jacfwd(slope)(at)
    np.testing.assert_allclose(second, second.T, rtol=1e-6)
    step = jnp.array([h, 0.0])
    by_hand = (slope(at + step) - slope(at - step)) / (2 * h)
    np.testing.assert_allclose(second[:, 0], by_hand, rtol=1e-6)
