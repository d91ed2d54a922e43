"""Slopes of what stands for a solid: coordinates, sections, identified laws."""

import functools
from dataclasses import replace

import jax.numpy as jnp

from sorojax import fem, material, mesh, reduction as R, rod
from tests.derivatives.case import Case

NONE = {
    "fits on the host, of numbers: the laws that they make have slopes": (
        "captured_energy condensed_stiffness identify identify_damping pod_basis"
    ),
    "the weight of a mesh, on the host": "offset_weight",
}

LENGTH = 0.06
BODY = mesh.rectangle([0, 0], [LENGTH, 0.012], divisions=(6, 2))
RUBBER = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.4, density=1e3)
LINE = R.Line([0.0, 0.006], [LENGTH, 0.006])
BASIS = rod.chebyshev(kappa_z=2, sigma_x=1)


@functools.cache
def path():
    held = fem.Fixed(mesh.nodes_where(BODY, lambda p: p[0] < 1e-9))
    tip = mesh.facets_where(BODY, lambda p: p[0] > LENGTH - 1e-9)
    problem = fem.problem(
        BODY,
        RUBBER,
        kinematics=fem.PlaneStrain(0.02),
        supports=(held,),
        loads=(fem.Traction(tip, name="pull", value=jnp.zeros(2)),),
    )
    return fem.solve_path(problem, pull=jnp.array([[0.0, 200.0], [0.0, 400.0]]))


def backbone(displacements, arm=None):
    return R.strain_along(
        replace(path(), displacements=displacements), LINE, samples=7, arm=arm
    )


def section(at):
    problem = path().problem
    moved = replace(problem, mesh=replace(problem.mesh, points=at))
    return R.mean_section(moved, LINE)


def in_motion(call):
    """The curve is looked up in the mesh on the host, so outside `jit`."""
    return lambda: Case(call, path().displacements, jit=False)


PRESSURE = R.PressureMap(
    [[1e-5, 2e-6], [2e-6, -1e-5]], [[0.1, 0.2], [0.01, -0.02]], [1e-4, 2e-5], 3e3
)
STATE = jnp.array([3.0, -2.0])
CASES = {
    "strain_along": in_motion(lambda u: backbone(u).strain),
    "strain_along with an arm": in_motion(lambda u: backbone(u, arm=0.003).strain),
    "coordinates": in_motion(lambda u: R.coordinates(backbone(u), BASIS)),
    "mean_section": lambda: Case(section, path().problem.mesh.points, jit=False),
    "PressureMap": Case(
        lambda at: at[0].coenergy(at[1], at[2]), (PRESSURE, STATE, jnp.asarray(2e3))
    ),
}
