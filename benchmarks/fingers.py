"""The soft finger D1: 80 mm long, 6 mm thick, clamped, straight along x, weight along -z.

Bending only: two curvatures of three Chebyshev modes, six coordinates. E = 1 MPa,
nu = 0.3, rho = 2000 kg/m^3.
"""

import jax.numpy as jnp
import numpy as np

from sorojax.math.lie import SE3
from sorojax.rod import Gravity, Rod, acceleration, chebyshev, circle, motion, rod
from sorojax.rod.dynamics.fields import Operators
from sorojax.units import MPa, mm

LENGTH = 80 * mm
MODES = 3


def finger(nodes: int, modes: int = MODES) -> Rod:
    """The rod with `nodes` Gauss nodes, and so many modes of each of its two curvatures."""
    return rod(
        SE3(),
        chebyshev(kappa_y=modes, kappa_z=modes),
        circle(6 * mm),
        length=LENGTH,
        young_modulus=1 * MPa,
        poisson_ratio=0.3,
        density=2000.0,
        nodes=nodes,
    )


def accelerate(rod: Rod, constants: Operators, q, v):
    """Acceleration under the weight."""
    zero = jnp.zeros((), q.dtype)
    return acceleration(rod, constants, zero, q, v, (Gravity(),))


def tip(rod: Rod, constants: Operators, q):
    """Position of the last section [m]."""
    return constants.weights @ motion(rod, q, constants=constants).tangent


def random_states(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of standard deviation 5 and rates of 20 [1/m], always the same."""
    draw = np.random.default_rng(0)
    size = 2 * MODES
    pairs = [(draw.normal(0, 5, size), draw.normal(0, 20, size)) for _ in range(count)]
    return np.array([q for q, _ in pairs]), np.array([v for _, v in pairs])
