"""Slopes of blocks, networks and motions in every number that they hold."""

import functools
from dataclasses import replace

import jax.numpy as jnp

from sorojax import fem, material, mesh, rod as R, sdf, systems as S
from sorojax.contact import LinePenalty
from sorojax.math.lie import SE2
from sorojax.rod.dynamics.rollout import Trajectory
from tests.derivatives.case import Case

NONE = {
    "a film's reader, or a loop that moves on the host": "last_state partitioned",
    "chooses cells on the host; what it makes has derivatives": "sampled_body",
}

SLOW = ("simulate_batch",)
FINGER = R.rod(
    SE2(),
    R.chebyshev(kappa_z=2),
    R.circle(6e-3),
    length=0.08,
    nodes=8,
    young_modulus=1e6,
    poisson_ratio=0.3,
    density=2000.0,
)
FORCES = (R.Gravity([0.0, -9.81]), R.Damping(0.02))
Q, V, T = jnp.array([4.0, -2.0]), jnp.array([10.0, 20.0]), jnp.asarray(0.3)
GOAL = S.Sine([1.0, 2.0], 3.0, [0.5, 0.1], 0.2)
PLACE = S.Waypoints([0.0, 1.0], [[0.07, 0.01], [0.06, 0.03]])
IMPEDANCE = S.CartesianImpedance(FINGER, FORCES, PLACE, 20.0, 2.0, 3.0)
LAWS = (
    S.ComputedTorque(FINGER, FORCES, GOAL, 400.0, 40.0),
    S.Compensation(FINGER, FORCES[:1], GOAL, 0.05, 0.001),
    S.FeedForward(FINGER, FORCES, GOAL),
    S.EnergyShaping(FINGER, FORCES[:1], S.TipSpring(FINGER, [0.06, 0.03], 2.0, 1e-5), 2e-6),
    IMPEDANCE,
)


def air(pressure=20e3, conductance=1e-9):
    """A vessel that a valve feeds and that leaks, under PI control of its pressure."""
    blocks = {
        "air": S.Reservoir(pressure, 1e-6, exponent=1.2, volume=1e-5, leakage=0.3),
        "valve": S.Valve(conductance, lag=0.01),
        "regulator": S.Regulator(1e-9, 1e-8),
        "lag": S.Lag(0.02),
        "sum": S.sum_of([1.0, 1.0], unit="kg/s"),
    }
    wires = {
        "valve.downstream": "air.pressure", "sum.a": "valve.mass_flow",
        "regulator.pressure": "air.pressure", "sum.b": "regulator.mass_flow",
        "lag.a": "air.pressure", "air.mass_flow": "sum.value",
    }  # fmt: skip
    return S.Network(blocks, wires, ("valve.command", "valve.upstream", "regulator.setpoint"))


INPUTS = {"valve.command": 0.6, "valve.upstream": 3e5, "regulator.setpoint": 5e4}
INPUTS = {name: jnp.asarray(value) for name, value in INPUTS.items()}
ARM = S.Network(
    {"body": S.RodBody(FINGER, FORCES, driven=True, q=Q, v=V), "law": LAWS[0]},
    {"body.effort": "law.effort", "law.q": "body.q", "law.v": "body.v"},
)


def ran(**options):
    def call(at):
        network, inputs = at
        film = S.simulate(network, 0.05, inputs=inputs, save=4, **options)
        return film.outputs, film.state

    return call


def resumed(at):
    first = S.simulate(at, 0.02, inputs=INPUTS, save=3, rtol=1e-10, atol=1e-10)
    options = dict(inputs=INPUTS, save=3, rtol=1e-10, atol=1e-10)
    return S.simulate(at, 0.02, resume=first, **options).outputs


def dense(at):
    film = S.simulate(*at, inputs=INPUTS, rtol=1e-10, atol=1e-10, dense=True, save=3)
    return S.state_at(film, jnp.asarray(0.023))


def sampled(at):
    network, law = at
    loop = S.Sampled(law, ("body.q", "body.v"), "body.effort")
    method = S.Rosenbrock2(refresh=True)
    return S.simulate_sampled(
        network, loop, 0.01, period=1e-3, substeps=1, method=method
    ).outputs


def batch(pressures):
    make = functools.partial(air, conductance=1e-9)
    return S.simulate_batch(make, pressures, 0.05, inputs=INPUTS, save=3, rtol=1e-9).outputs


def algebra(at):
    factor, weights, x = at
    twice, total = S.gain(factor), S.sum_of(weights)
    added = total.output("value", T, {}, {"a": x, "b": 2 * x})
    return twice.output("value", T, {}, {"a": x}), added


def equal(at):
    blocks = S.stack([S.Lag(time) for time in at])
    rate = blocks.vector_field(T, blocks.initial_state(), {"a": jnp.ones(2)})
    return rate, blocks.initial_state()


def efforts(at):
    laws, q, v = at
    return [law.effort(T, q, v) for law in laws]


def moments(at):
    law, q, v = at
    still = Trajectory(jnp.array([0.1, 0.2]), jnp.stack([q, 2 * q]), jnp.stack([v, v]), None)
    return S.tracking(law, still)


FLOOR = sdf.Rectangle([-1.0, -1.0], [1.0, -0.005])


def pressed(at):
    law, q, v = at
    contact = R.ObstacleContact(FLOOR, 6e-3, law, points=16)
    found = S.contact_history(FINGER, (contact,), q[None], v[None])
    return found.overlap, found.push, found.effort


def seen(at):
    positions, trust = at
    markers = S.Markers(FINGER, [0.5, 1.0])
    return S.estimate_shape(markers, positions, Q, trust=trust, iterations=8).q


def filtered(at):
    q, positions = at
    markers = S.Markers(FINGER, [0.5, 1.0])
    estimator = S.ShapeFilter(markers, 0.02)
    last = S.start_filter(estimator, q)
    after = S.update_filter(estimator, last, positions, forces=FORCES)
    return after.q, after.v, after.covariance


PLACES = R.forward_kinematics(FINGER, 1.1 * Q, jnp.array([0.5, 1.0]))[:, :2, 2]


@functools.cache
def solid():
    body = mesh.rectangle([0, 0], [0.06, 0.01], divisions=(4, 1))
    rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.4, density=1e3)
    held = fem.Fixed(mesh.nodes_where(body, lambda p: p[0] < 1e-9))
    problem = fem.problem(body, rubber, supports=(held,), kinematics=fem.PlaneStrain(0.02))
    made = S.FemBody(problem)
    return made, S.modal_basis(made, 2, bending=False)


def few_shapes():
    body, basis = solid()

    def call(at):
        modal = S.modal_body(at[0], basis)
        return modal.vector_field(T, {"q": at[1], "v": 0.1 * at[1]}, {}), S.displacement(
            basis, at[1]
        )

    return Case(call, (body, jnp.array([1e-3, 2e-3])), reverse=False, step=1e-4)


def shapes(at):
    """Eigenmodes, the answer to a pressure, and derivatives of these along each other."""
    return S.modal_basis(at[0], 2, displacement=at[1]).shapes


def inflated():
    problem = solid()[0].problem
    top = mesh.facets_where(problem.mesh, lambda p: p[1] > 0.01 - 1e-9)
    problem = replace(problem, loads=(fem.Pressure(top, name="air"),))
    u = 1e-4 * jnp.sin(jnp.arange(problem.mesh.points.size)).reshape(-1, 2)
    return Case(shapes, (S.FemBody(problem), u), jit=False, rtol=1e-6, step=1e-4)


CASES = {
    "simulate: adaptive": Case(
        ran(rtol=1e-10, atol=1e-10), (air(), INPUTS), rtol=1e-5, step=1e-4, forward=False
    ),
    "simulate: resumed": Case(resumed, air(), rtol=1e-5, step=1e-4, forward=False),
    "simulate: fixed steps": Case(
        ran(step=1e-3, solver=S.Tsit5()), (ARM, {}), step=1e-4, forward=False
    ),
    "simulate: stiff": Case(
        ran(step=1e-3, solver=S.Rodas4()), (air(), INPUTS), step=1e-4, forward=False
    ),
    "state_at": Case(lambda at: dense((at, 0.05)), air(), rtol=1e-5, step=1e-4, forward=False),
    "simulate_sampled": Case(
        sampled,
        (S.Network({"body": ARM.blocks["body"]}, {}, ("body.effort",)), LAWS[0]),
        step=1e-4,
        forward=False,
    ),
    "simulate_batch": Case(batch, jnp.array([10e3, 40e3]), rtol=1e-5, forward=False, jit=False),
    "as_term, outputs": Case(
        lambda at: (
            S.as_term(at[0], at[1]).vf(T, at[0].initial_state(), None),
            S.outputs(at[0], T, at[0].initial_state(), at[1]),
        ),
        (air(), INPUTS),
    ),
    "gain, sum_of": Case(algebra, (2.0, jnp.array([1.0, -1.0]), jnp.asarray(3.0))),
    "stack": Case(equal, (0.02, 0.03)),
    "effort of each law": Case(efforts, (LAWS, Q, V), step=1e-4, reverse=False),
    "tracking": Case(moments, (IMPEDANCE, Q, V), step=1e-4, reverse=False),
    "contact_history": Case(
        pressed, (LinePenalty(5e5, 2e-5, friction=0.3), -Q, V), step=1e-6, rtol=1e-5
    ),
    "body_motion": Case(
        lambda at: S.body_motion(at, at.initial_state()).tangent, ARM.blocks["body"]
    ),
    "estimate_shape": Case(seen, (PLACES, 1e-3), step=1e-4, rtol=1e-5),
    "start_filter, update_filter": Case(filtered, (Q, PLACES), step=1e-4),
    "modal_body, displacement": few_shapes,
    "modal_basis": inflated,
}
