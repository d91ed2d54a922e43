"""Slopes of what stands for a solid: coordinates, stiffness, pressure maps."""

import functools

import jax.numpy as jnp
import numpy as np

from sorojax import fem, material, mesh, reduction as R, replace, rod
from sorojax.math.lie import SE2
from tests.derivatives.case import Case

NONE = {
    "a fit on the host, of numbers: the law that it makes is differentiable": (
        "identify identify_damping pod_basis captured_energy"
    ),
    "mass of a mesh, on the host": "mean_section offset_weight",
}

LENGTH = 0.06
BODY = mesh.rectangle([0, 0], [LENGTH, 0.012], divisions=(6, 2))
PROBLEM = fem.problem(
    BODY,
    material.neo_hookean(young_modulus=1e6, poisson_ratio=0.4, density=1e3),
    supports=(fem.Fixed(mesh.nodes_where(BODY, lambda p: p[0] < 1e-9)),),
)
LINE = R.Line([0.0, 0.006], [LENGTH, 0.006])
BASIS = rod.chebyshev(kappa_z=2, sigma_x=1)


def path_of(u):
    solution = fem.Solution
    return solution, u


CASES = {}
