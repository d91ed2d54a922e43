"""Networks that move the supports of finite-element bodies, and feel their reactions."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import Status, fem, mesh, systems
from sorojax.math.linalg import sparse
from tests.test_fem_supports import RUBBER, SHARP, SIDE, shaken_bar


class Shaker(systems.AbstractReference):
    """Displacement of a foot, along the bar."""

    foot: Any

    def __call__(self, t):
        return jnp.stack([self.foot(t), 0 * t])


def shaken_network():
    problem, velocity, foot, force = shaken_bar()
    body = systems.FemBody(problem, driven=("foot",), v=velocity)
    source = systems.Source(Shaker(foot), unit="m")
    network = systems.Network({"bar": body, "shaker": source}, {"bar.foot": "shaker.value"})
    return network, force


def test_a_driven_support_moves_a_body_as_simulate_does():
    network, force = shaken_network()
    problem, velocity, foot, _ = shaken_bar()
    errors = []
    for step in (1e-3, 5e-4):
        film = systems.simulate(network, 0.03, step=step, save=int(0.03 / step) + 1)
        want = jax.vmap(force)(film.time)
        got = film.outputs["bar.foot_force"][:, 0]
        errors.append(float(jnp.max(jnp.abs(got - want)[2:]) / jnp.max(jnp.abs(want))))
    alone = fem.simulate(
        problem,
        0.03,
        5e-4,
        start=(jnp.zeros_like(velocity), velocity),
        foot=lambda t: jnp.stack([foot(t), 0 * t]),
    )
    size = float(jnp.max(jnp.abs(alone.displacements)))
    gap = film.state["bar"]["u"] - alone.displacements
    assert jnp.max(jnp.abs(gap)) < 1e-8 * size
    assert errors[1] < 0.03 and errors[0] / errors[1] > 3.3


class Ball(systems.AbstractBlock):
    """A point mass that a force pulls."""

    mass: jax.Array
    speed: jax.Array

    @property
    def inputs(self):
        return {"force": systems.Input("N", (2,), 0.0)}

    @property
    def outputs(self):
        return {"moved": systems.Output("m", (2,))}

    def initial_state(self):
        return {"x": jnp.zeros(2), "v": self.speed}

    def output(self, name, t, state, inputs):
        return state["x"]

    def vector_field(self, t, state, inputs):
        return {"x": state["v"], "v": -inputs["force"] / self.mass}


def carried(share, speed: Any = (0.3, 0.0), start=None, gravity=None) -> Any:
    """A block of rubber that a ball of `share` of its mass carries."""
    cells = mesh.rectangle([0, 0], [0.04, 0.01], divisions=(2, 1), element=mesh.Quad4())
    held = fem.Prescribed(cells.node_sets["left"], [0.0, 0.0], name="grip")
    loads = () if gravity is None else (fem.Gravity(gravity),)
    problem = fem.problem(
        cells, RUBBER, kinematics=fem.PlaneStrain(SIDE), supports=(held,), loads=loads
    )
    speed = jnp.asarray(speed)
    v = jnp.broadcast_to(speed, cells.points.shape) if start is None else start
    body = systems.FemBody(problem, driven=("grip",), v=v, energies=True)
    ball = Ball(share * fem.total_mass(problem), speed)
    wires = {"solid.grip": "ball.moved", "ball.force": "solid.grip_force"}
    return systems.Network({"solid": body, "ball": ball}, wires)


def momentum(network, state):
    problem = network.blocks["solid"].problem
    v = state["solid"]["v"]
    mass = fem.mass_matrix(problem)
    p = jax.vmap(lambda v: sparse.product(problem.space.system, mass, v.ravel()))(v)
    return (
        jnp.sum(p.reshape(v.shape), axis=1) + network.blocks["ball"].mass * state["ball"]["v"]
    )


@pytest.mark.parametrize("share", [0.01, 1.0, 10.0])
def test_a_ball_of_any_mass_carries_a_solid(share):
    """The solid is stretching at the start. Reactions and inertia are of one step, so nothing
    grows however heavy the solid is: what momentum is missed is missed in the first steps,
    and is of second order in their length."""
    network = carried(share)
    x = network.blocks["solid"].problem.mesh.points[:, 0]
    stretching = jnp.zeros((x.size, 2)).at[:, 0].set(0.3 + 20 * x)
    network = eqx.tree_at(lambda n: n.blocks["solid"].v, network, stretching)
    missed = []
    for step in (2.5e-4, 1.25e-4):
        film = systems.simulate(network, 0.04, step=step, save=5)
        assert film.status == Status.successful
        p = momentum(network, film.state)
        off = jnp.abs(p - p[:1]) / p[0, 0]
        missed.append(float(off[-1, 0]))
        assert jnp.max(off[1:, 0]) < 1.001 * jnp.min(off[1:, 0])
        assert jnp.max(off[:, 1]) < 1e-12
    assert missed[1] < 2e-3 and missed[0] / missed[1] > 2.8


def test_a_ball_falls_with_the_solid_that_it_carries():
    """Both are accelerated by the weight of the solid alone."""
    network = carried(0.5, speed=(0.0, 0.0), gravity=[2.0, 0.0])
    film = systems.simulate(network, 0.05, step=1e-3, save=2)
    solid = network.blocks["solid"].problem
    p = momentum(network, film.state)[-1, 0]
    want = 2.0 * 0.05 * float(fem.total_mass(solid))
    np.testing.assert_allclose(p, want, rtol=0.02)


def turned_network(amplitude) -> Any:
    cells = mesh.rectangle([0, 0], [0.04, 0.01], divisions=(2, 1), element=mesh.Quad4())
    left = cells.node_sets["left"]
    hand = fem.Rotated(left, cells.points[left], 0.0, [0.0, 0.005], name="hand")
    problem = fem.problem(cells, RUBBER, kinematics=fem.PlaneStrain(SIDE), supports=(hand,))
    wave = systems.Sine(amplitude, 20.0, phase=-jnp.pi / 2, offset=amplitude)
    blocks = {
        "arm": systems.FemBody(problem, driven=("hand",), energies=True),
        "motor": systems.Source(wave, unit="rad"),
    }
    return systems.Network(blocks, {"arm.hand": "motor.value"})


def test_the_torque_of_a_turned_support_times_its_rate_is_power():
    solver = systems.Coupled(rho_inf=0.95)  # forces act nearly in the middle of a step
    film = systems.simulate(turned_network(0.2), 0.05, step=5e-4, save=101, solver=solver)
    torque, angle = film.outputs["arm.hand_torque"], film.outputs["motor.value"]
    work = jnp.cumsum((torque[1:] + torque[:-1]) / 2 * jnp.diff(angle))
    given = film.outputs["arm.work"]
    assert jnp.max(jnp.abs(work - given[1:])) < 0.01 * jnp.max(given)
    energy = film.outputs["arm.kinetic_energy"] + film.outputs["arm.elastic_energy"]
    assert jnp.max(jnp.abs(energy - given)) < 0.01 * jnp.max(given)


def test_gradients_through_driven_supports_agree_with_differences():
    network = carried(0.5)

    def end(numbers):
        mass, modulus, speed = numbers
        at = eqx.tree_at(
            lambda n: (
                n.blocks["ball"].mass,
                n.blocks["solid"].problem.material.shear_modulus,
                n.blocks["ball"].speed,
            ),
            network,
            (mass, modulus, speed),
        )
        film = systems.simulate(
            at, 4e-3, step=1e-3, save=5, solver=systems.Coupled(newton=SHARP)
        )
        pulled = film.outputs["solid.grip_force"]
        return jnp.sum(jnp.sin(300 * film.state["ball"]["x"])) + jnp.sum(pulled[1:] ** 2)

    ball, solid = network.blocks["ball"], network.blocks["solid"]
    at = [ball.mass, solid.problem.material.shear_modulus, jnp.asarray([0.31, 0.1])]
    end, slopes = jax.jit(end), jax.jit(jax.grad(end))(at)
    way = [0.7 * at[0], 0.4 * at[1], jnp.asarray([0.2, -0.3])]
    along = sum(jnp.sum(a * b) for a, b in zip(slopes, way, strict=True))
    values = [
        end([a + k * 1e-3 * b for a, b in zip(at, way, strict=True)]) for k in (-2, -1, 1, 2)
    ]
    low2, low, high, high2 = values
    want = (low2 - 8 * low + 8 * high - high2) / 12e-3
    np.testing.assert_allclose(along, want, rtol=1e-7)


def test_driven_supports_are_checked():
    network = carried(1.0)
    body = network.blocks["solid"]
    with pytest.raises(ValueError, match="names 0 loads and supports"):
        systems.FemBody(body.problem, driven=("hand",))
    with pytest.raises(ValueError, match="need one of fixed steps"):
        systems.simulate(network, 0.01, step=1e-3, solver=systems.RungeKutta4())
    with pytest.raises(ValueError, match="need a body whose supports stay"):
        systems.modal_body(body, systems.modal_basis(body, modes=1))
