"""A soft hand under a sampled controller, one second: as a stack, as blocks, and by hand.

Five planar fingers of five modes, five reservoirs, 55 states, a controller at 100 Hz, two
fixed steps between its calls.
"""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.hands import PERIOD, Grip, hand, lengths, separate
from benchmarks.harness import Row, measure, measure_together
from sorojax import systems
from sorojax.math.linalg.dense import solve_symmetric
from sorojax.rod import Pressurised, inertia, motion, total_force

SUBSTEPS = 2
BAR = 20e-3  # s per simulated second
RATIO = 1.2  # of the network to the monolith
CALLS = 1000
PORT = "fingers.air.mass_flow"


def second(network, substeps=SUBSTEPS, refresh=False):
    grip = systems.Sampled(Grip(), "fingers.air.pressure", PORT)
    film = systems.simulate_sampled(
        network,
        grip,
        1.0,
        period=PERIOD,
        substeps=substeps,
        method=systems.Rosenbrock2(refresh),
    )
    return film["fingers.body.tip_position"]


def monolith(network, state, flow):
    """The field of the hand with nothing but arrays in between."""
    fingers = network.blocks["fingers"].block

    def one(body, air, q, v, pressure, flow):
        chamber = body.forces[0]
        gauge = pressure - air.atmosphere
        moment = motion(body.rod, q, v)
        mass, coriolis = inertia(moment)
        forces = (Pressurised(chamber, gauge), *body.forces[1:])
        force = total_force(forces, jnp.zeros(()), moment)
        volume, rate = jax.jvp(chamber.volume, (q,), (v,))
        supply = air.gas_constant * air.temperature * flow
        return (
            v,
            solve_symmetric(mass, force - coriolis),
            (supply - pressure * rate) / (volume + air.dead_volume),
        )

    body, air = fingers.blocks["body"], fingers.blocks["air"]
    own = state["fingers"]
    rates = jax.vmap(one)(body, air, own["body"]["q"], own["body"]["v"], own["air"], flow)
    return {"fingers": {"body": {"q": rates[0], "v": rates[1]}, "air": rates[2]}}


def loops():
    def wired(network, state, flow):
        return network.vector_field(jnp.zeros(()), state, {PORT: flow})

    def loop(field):
        def run(network, state, flow):
            def one(_, state):
                rate = field(network, state, flow)
                return jax.tree.map(lambda x, k: x + 1e-9 * k, state, rate)

            return jax.lax.fori_loop(0, CALLS, one, state)

        return run

    return {"network": loop(wired), "monolith": loop(monolith)}


def rows():
    network = hand()
    fine = np.asarray(second(network, 16, True))
    got = np.asarray(second(network))
    timing = measure(second, network, repeats=15)
    yield Row(
        "sorojax",
        {"as": "stack", "substeps": SUBSTEPS},
        **timing.columns(),
        bar=BAR,
        error=float(np.abs(got - fine).max()),
        reference="16 substeps, tips in m",
    )
    state = jax.tree.map(lambda x: x + 0.01 * jnp.abs(x), network.initial_state())
    times = measure_together(loops(), network, state, jnp.full(5, 1e-7), repeats=15)
    bar = RATIO * times["monolith"].columns()["run_s"] / CALLS
    for name, timing in times.items():
        yield Row(
            "sorojax",
            {"as": name, "of": "one vector field"},
            **timing.per(CALLS).columns(),
            bar=bar if name == "network" else None,
        )
    apart = separate()
    flow = {name: jnp.asarray(1e-7) for name in apart.inputs}

    def each(network, state):
        def one(_, state):
            rate = network.vector_field(jnp.zeros(()), state, flow)
            return jax.tree.map(lambda x, k: x + 1e-9 * k, state, rate)

        return jax.lax.fori_loop(0, CALLS, one, state)

    timing = measure(each, apart, apart.initial_state()).per(CALLS)
    settings = {"as": f"{len(lengths())} separate blocks", "of": "one vector field"}
    yield Row("sorojax", settings, **timing.columns())
