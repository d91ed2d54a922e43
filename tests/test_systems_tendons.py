"""Tendons that a network commands, alone and in an assembly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import replace, rod as R, systems as S
from sorojax.math.lie import SE2

ROD = R.rod(
    SE2(), R.chebyshev(kappa_z=2, sigma_x=1), R.circle(4e-3),
    length=0.08, young_modulus=1e6, poisson_ratio=0.4, density=1000.0, nodes=6,
)  # fmt: skip
ROUTES = (R.Converging([3e-3, 0.0], [1e-3, 0.0]), R.Straight([-2e-3, 0.0]))
PULL = jnp.array([0.3, 0.1])
Q, V = jnp.array([4.0, -2.0, 0.02]), jnp.array([0.5, 1.0, -0.1])
WEIGHT = R.Gravity([0.0, -9.81])


def alone(*forces):
    return S.RodBody(ROD, (WEIGHT, R.Damping(0.02), *forces), q=Q, v=V)


def beside_a_link(tendons):
    palm = R.Link(0.1, 1e-5, [0.01, 0.0])
    model = R.assembly(
        SE2(), palm=R.Part(palm, R.Revolute()), finger=R.Part(ROD, R.Fixed(), on="palm")
    )
    q, v = (jnp.concatenate([jnp.array([x]), y]) for x, y in ((0.2, Q), (0.3, V)))
    return S.AssemblyBody(model, (WEIGHT, R.PartForce("finger", tendons)), q=q, v=v)


def rate(body, **inputs):
    wanted = {
        name: inputs.get(name, jnp.zeros(port.shape)) for name, port in body.inputs.items()
    }
    return body.vector_field(0.0, body.initial_state(), wanted)["v"]


@pytest.mark.parametrize("friction", [None, 0.3])
def test_a_commanded_tension_is_the_force_of_a_known_one(friction):
    open_ended = R.Tendons(ROUTES, friction=friction)
    known = R.Tendons(ROUTES, PULL, friction)
    assert np.allclose(rate(alone(open_ended), tension=PULL), rate(alone(known)), rtol=1e-12)
    mine = rate(beside_a_link(open_ended), finger_tension=PULL)
    assert np.allclose(mine, rate(beside_a_link(known)), rtol=1e-12)
    assert not np.allclose(mine, rate(beside_a_link(open_ended)), rtol=1e-3)


def test_a_tendon_does_not_push():
    body = alone(R.Tendons(ROUTES))
    slack = rate(body, tension=jnp.array([-1.0, 0.1]))
    assert np.allclose(slack, rate(body, tension=jnp.array([0.0, 0.1])), rtol=1e-12)


@pytest.mark.parametrize("make, prefix", [(alone, ""), (beside_a_link, "finger_")])
def test_lengths_of_tendons_and_their_rates(make, prefix):
    body = make(R.Tendons(ROUTES))
    state = body.initial_state()

    def read(name, state):
        return body.output(f"{prefix}{name}", 0.0, state, {})

    length = read("tendon_length", state)
    assert np.allclose(length, R.thread_lengths(ROD, ROUTES, Q), rtol=1e-12)

    def ahead(h):
        return read(
            "tendon_length", replace(state, lambda s: s["q"], state["q"] + h * state["v"])
        )

    slope = jax.jvp(ahead, (0.0,), (1.0,))[1]
    assert np.allclose(read("tendon_rate", state), slope, rtol=1e-10)


def test_the_port_of_one_tendon_is_a_number():
    body = alone(R.Tendons(ROUTES[0]))
    assert body.inputs["tension"].shape == body.outputs["tendon_rate"].shape == ()
    known = R.Tendons(ROUTES[0], 0.3)
    assert np.allclose(rate(body, tension=jnp.array(0.3)), rate(alone(known)), rtol=1e-12)


@pytest.mark.slow
def test_work_on_tendons_is_what_the_body_gains():
    """A lag pulls one; power -T dl/dt, motion and bending balance over a run."""
    body = S.RodBody(ROD, (R.Tendons(ROUTES[0]),), q=Q, v=V)
    wires = {"body.tension": "motor.value"}
    network = S.Network({"motor": S.Lag(0.02, unit="N"), "body": body}, wires, ("motor.a",))
    film = S.simulate(network, 0.1, inputs={"motor.a": 0.4}, save=401, rtol=1e-9, atol=1e-11)
    q, v = film["body.q"], film["body.v"]
    stiffness = -jax.jacfwd(lambda q: R.total_force((), 0.0, R.motion(ROD, q)))(0 * Q)
    bent = jnp.einsum("ti,ij,tj->t", q, stiffness, q) / 2
    moving = jax.vmap(lambda q, v: v @ R.mass_matrix(ROD, q) @ v / 2)(q, v)
    power = -film["motor.value"] * film["body.tendon_rate"]
    shares = jnp.ones(401).at[1:-1:2].set(4.0).at[2:-1:2].set(2.0)  # Simpson's rule
    work = shares @ power * film.time[1] / 3
    gained = (bent + moving)[-1] - (bent + moving)[0]
    assert abs(float(work - gained)) < 1e-4 * float(jnp.max(moving))


def test_what_a_network_cannot_command_is_refused():
    open_ended = R.Tendons(ROUTES)
    with pytest.raises(ValueError, match=r"Tendons: got no `tension`.*wire its `tension`"):
        R.equilibrium(ROD, (open_ended,))
    with pytest.raises(ValueError, match="RodBody: got 2 Tendons without tension"):
        alone(open_ended, open_ended)
    twice = (R.PartForce("finger", open_ended),) * 2
    with pytest.raises(ValueError, match="AssemblyBody: `finger` has 2 Tendons without"):
        S.AssemblyBody(beside_a_link(open_ended).assembly, twice)
