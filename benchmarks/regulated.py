"""A finger with two regulated chambers, from easy to stiff, for the cases of systems.

Three modes of 5.7, 35.5 and 67.6 Hz with cubic stiffness, two chambers whose volumes
follow the modes, their rate by a filter, two saturated proportional-integral regulators:
12 states. `gain` scales regulators and filter: the fastest eigenvalue is about 50 gain 1/s.
"""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from sorojax import systems
from sorojax._types import real
from sorojax.systems.blocks.block import AbstractBlock, Input, Output

FREQUENCIES = 5.7, 35.5, 67.6  # Hz
MASS = 1e-4  # kg of every mode
SUPPLY = 287.05 * 293.15  # J/kg
VOLUME = 1e-5  # m^3 of a chamber at rest
SLOPES = ((4e-6, -4e-6), (6e-6, 6e-6), (5e-6, 5e-6))  # m^3 per unit of a mode


class ModalFinger(AbstractBlock):
    """Modes of a finger, driven by the pressures of its chambers."""

    frequency: Float[Array, " modes"] = eqx.field(converter=real, default=FREQUENCIES)
    mass: Float[Array, ""] = eqx.field(converter=real, default=MASS)
    slopes: Float[Array, "modes ports"] = eqx.field(converter=real, default=SLOPES)
    damping: Float[Array, ""] = eqx.field(converter=real, default=0.05)
    cubic: Float[Array, ""] = eqx.field(converter=real, default=0.5)

    @property
    def inputs(self):
        return {"pressure": Input("Pa", self.slopes.shape[1:])}

    @property
    def outputs(self):
        return {"volume": Output("m^3", self.slopes.shape[1:]), "q": Output(None, (3,))}

    def initial_state(self):
        return {"q": jnp.zeros(3, self.mass.dtype), "v": jnp.zeros(3, self.mass.dtype)}

    def output(self, name, t, state, inputs):
        return state["q"] if name == "q" else VOLUME + state["q"] @ self.slopes

    def vector_field(self, t, state, inputs):
        q, v = state["q"], state["v"]
        omega = 2 * np.pi * self.frequency
        load = self.slopes @ inputs["pressure"] / self.mass
        elastic = omega**2 * (q + self.cubic * q**3)
        return {"q": v, "v": load - elastic - 2 * self.damping * omega * v}


class Targets(AbstractBlock):
    """Two pressures that swing at 2 Hz, out of phase."""

    @property
    def inputs(self):
        return {}

    @property
    def outputs(self):
        return {"value": Output("Pa", (2,))}

    def initial_state(self):
        return {}

    def output(self, name, t, state, inputs):
        phase = jnp.array([0.0, np.pi], t.dtype)
        return 8e3 * (1 - jnp.cos(4 * np.pi * t + phase))

    def vector_field(self, t, state, inputs):
        return {}


def regulated(gain) -> systems.Network:
    """The network at a gain: 10 is easy, 1000 stiff."""
    gain = real(gain)
    proportional = 50 * gain * VOLUME / SUPPLY
    full = jnp.full(2, VOLUME, gain.dtype)
    blocks = {
        "air": systems.Reservoir(ports=2, bandwidth=50 * gain, start_volume=full),
        "finger": ModalFinger(),
        "target": Targets(),
        "valve": systems.Regulator(proportional, 20 * proportional, max_flow=1e-4, ports=2),
    }
    wires = {
        "finger.pressure": "air.pressure",
        "air.volume": "finger.volume",
        "air.mass_flow": "valve.mass_flow",
        "valve.pressure": "air.pressure",
        "valve.setpoint": "target.value",
    }
    return systems.Network(blocks, wires)


def solver_run(solver: dfx.AbstractSolver, control, duration: float = 1.0):
    """A function of the network: modes at the end, and the number of steps.

    The state is one vector for every solver, which is faster for all.
    """

    def run(network):
        start, unravel = ravel_pytree(network.initial_state())

        def field(t, x, network):
            return ravel_pytree(network.vector_field(t, unravel(x)))[0]

        solution = dfx.diffeqsolve(
            dfx.ODETerm(field),
            solver,
            0.0,
            duration,
            None,
            start,
            args=network,
            stepsize_controller=control,
            max_steps=400_000,
        )
        assert solution.ys is not None
        return unravel(solution.ys[0])["finger"]["q"], solution.stats["num_steps"]

    return run


def reference(gain, duration: float = 1.0) -> np.ndarray:
    """Modes at the end by SciPy's Radau to 1e-11."""
    from scipy.integrate import solve_ivp

    network = regulated(gain)
    start, unravel = ravel_pytree(network.initial_state())

    def field(t, x):
        return ravel_pytree(network.vector_field(t, unravel(x)))[0]

    rate, slope = jax.jit(field), jax.jit(jax.jacfwd(field, 1))
    found = solve_ivp(
        lambda t, x: np.asarray(rate(t, x)),
        (0.0, duration),
        np.asarray(start),
        method="Radau",
        rtol=1e-11,
        atol=1e-13,
        jac=lambda t, x: np.asarray(slope(t, x)),
    )
    return np.asarray(unravel(jnp.asarray(found.y[:, -1]))["finger"]["q"])


def error(got, want) -> float:
    """Relative error in the norm."""
    return float(np.linalg.norm(np.asarray(got) - want) / np.linalg.norm(want))
