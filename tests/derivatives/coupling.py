"""Slopes of the energy and the wrench of rods on solids."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from sorojax import coupling, fem, rod as R
from sorojax.math.lie import SE2, SE3
from tests.derivatives.case import Case
from tests.derivatives.fem import DEPTH, LEFT, PLATE, RIGHT, RUBBER, SOLID, moved

NONE: dict[str, str] = {}
ROD = {"length": 0.8, "nodes": 8, "young_modulus": 3.0, "poisson_ratio": 0.3, "density": 0.2}
PLANAR = R.rod(SE2(), R.chebyshev(kappa_z=2), R.circle(0.2), **ROD)
SPATIAL = R.rod(SE3(), R.chebyshev(kappa_y=1, kappa_z=1, kappa_x=1), R.circle(0.2), **ROD)


def planar():
    base = np.array([[0.8, -0.6, 1.5], [0.6, 0.8, 0.25], [0, 0, 1]])
    cells, load = coupling.mounted_rod(
        PLATE, PLANAR, RIGHT, base, value=[0.02, 0.03], gravity=[0.1, -0.3]
    )
    held = (fem.Fixed(LEFT),)
    return fem.problem(cells, RUBBER, kinematics=DEPTH, supports=held, loads=(load,))


def spatial():
    x, *_ = np.asarray(SOLID.points).T
    low, high = np.flatnonzero(x < 1e-9), np.flatnonzero(x > x.max() - 1e-9)
    base = np.eye(4)
    base[:3, 3] = np.asarray(SOLID.points)[high].mean(axis=0)
    cells, load = coupling.mounted_rod(SOLID, SPATIAL, high, base, value=[0.01, 0.03, 0.02])
    return fem.problem(cells, RUBBER, supports=(fem.Fixed(low),), loads=(load,))


def by_hand(at):
    """From the pose of the base and the force."""
    pose, force, points = at
    cells = eqx.tree_at(lambda m: m.points, PLATE, points)
    cells, load = coupling.mounted_rod(cells, PLANAR, RIGHT, pose, value=force)
    held = (fem.Fixed(LEFT),)
    problem = fem.problem(cells, RUBBER, kinematics=DEPTH, supports=held, loads=(load,))
    return fem.potential_energy(*moved(problem))


POSE = jnp.asarray([[1.0, 0.0, 1.5], [0.0, 1.0, 0.25], [0.0, 0.0, 1.0]])
OPTIONS = {"forward": False, "step": 1e-4}
CASES = {
    "mounted_rod": lambda: Case(
        by_hand, (POSE, jnp.asarray([0.02, 0.03]), PLATE.points), jit=False, **OPTIONS
    ),
    "mounted_rod in space": lambda: Case(
        lambda at: fem.potential_energy(*at), moved(spatial()), **OPTIONS
    ),
    "mount_wrench": lambda: Case(
        lambda at: coupling.mount_wrench(*at), moved(planar()), **OPTIONS
    ),
}
