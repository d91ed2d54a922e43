"""Slopes of gaps, pressures and forces, away from the moment of touch."""

import jax.numpy as jnp
import numpy as np

from sorojax import contact as C, sdf
from sorojax.contact.facet import contacts, gaps
from sorojax.contact.friction import Grip
from tests.derivatives.case import Case

NONE: dict[str, str] = {}

BALL = sdf.Sphere([0.0, 0.0, 0.0], 0.05)
POINTS = 0.05 * jnp.asarray(np.eye(3)[[0, 1, 2]] * [[0.96], [1.0], [1.02]]) + 1e-3
LAW = C.Penalty(1e7, 1e-3)
RUBS = {
    "Coulomb": C.SpringSlider(C.Coulomb(0.4), 1e6),
    "DirectionalCoulomb": C.SpringSlider(C.DirectionalCoulomb(0.3, 0.6, [1.0, 0.2]), 1e6),
}

CASES = {
    "gaps": Case(lambda at: gaps(*at), (BALL, POINTS, jnp.array([1e-3, 0, 2e-3]))),
    "contacts": Case(
        lambda at: contacts(*at),
        (LAW, BALL, POINTS, jnp.full(3, 1e-4), jnp.array([1e-3, 0.0, 2e-3])),
        step=1e-6,
        rtol=1e-6,
    ),
    "contacts of spheres": Case(
        lambda at: contacts(*at[:-1], offset=at[-1]),
        (LAW, BALL, 1.1 * POINTS, jnp.full(3, 1e-4), jnp.full(3, 5e-3)),
        step=1e-6,
        rtol=1e-6,
    ),
}
GAPS = jnp.array([-3e-3, -5e-4, -1e-4])  # deep, and on the smooth start
LINE = C.LinePenalty(5e6, 1e-3, friction=0.3, damping=0.1)
CASES |= {
    "Penalty": Case(lambda at: (at[0].energy(at[1]), at[0].pressure(at[1])), (LAW, GAPS)),
    "Penalty over a step": Case(
        lambda at: at[0].mean_pressure(at[1], at[2]), (LAW, GAPS, GAPS - 2e-3)
    ),
    "LinePenalty": Case(
        lambda at: (at[0].energy(at[1]), at[0].pressure(at[1]), at[0].slope(at[1])),
        (LINE, GAPS),
    ),
}
GRIP = Grip(
    jnp.full((3, 2), 1e-7), jnp.array([9.0, 8.0, 7.0]), jnp.tile(jnp.array([0.0, 1.0]), (3, 1)),
    jnp.full(3, 2e5), jnp.full((3, 2), 1e-6),
)  # fmt: skip
SLID = jnp.array([[2e-5, 0.0], [1e-6, 0.0], [-2e-5, 0.0]])  # it slides, holds, slides back
CASES |= {
    f"SpringSlider, {name}": Case(
        lambda at: (at[0].energy(*at[1:]), at[0].traction(*at[1:]), at[0].stretch(*at[1:])),
        (rub, GRIP, SLID),
    )
    for name, rub in RUBS.items()
}
