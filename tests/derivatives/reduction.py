"""Slopes of what stands for a solid: coordinates, sections, identified laws."""

import functools
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from sorojax import SE2, fem, material, mesh, reduction as R, rod
from tests.derivatives.case import Case

NONE: dict[str, str] = {}

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
    """Which cells hold the curve is looked up on the host, so outside `jit`."""
    return lambda: Case(call, path().displacements, jit=False)


@functools.cache
def inflated():
    """States under a pressure on the upper side, and a backbone whose cells are kept."""
    problem, top = path().problem, mesh.facets_where(BODY, lambda p: p[1] > 0.012 - 1e-9)
    problem = replace(problem, loads=(fem.Pressure(top, name="air"),))
    states = fem.solve_path(problem, air=jnp.array([100.0, 200.0, 400.0]))
    return states, R.strain_along(states, LINE, samples=7)


def numbers():
    """Of the whole path: displacements, nodes, material, thickness, pressures and curve."""
    states, problem = inflated()[0], inflated()[0].problem
    return (
        states.displacements,
        problem.mesh.points,
        problem.material,
        problem.kinematics,
        states.values,
        LINE,
    )


def moved(at):
    displacements, points, law, kinematics, values, line = at
    states, near = inflated()
    problem = states.problem
    problem = replace(
        problem,
        mesh=replace(problem.mesh, points=points),
        material=law,
        kinematics=kinematics,
    )
    states = replace(states, problem=problem, displacements=displacements, values=values)
    return states, line, R.strain_along(states, line, samples=7, near=near)


def modes(at):
    """Bending modes, which are of order one, and the share that they hold."""
    backbone = moved(at)[2]
    basis = R.pod_basis(backbone, modes={"kappa_z": 2}, within=rod.Legendre(4))
    return basis(jnp.linspace(0.0, 1.0, 5)), R.captured_energy(backbone, basis)


def identified(at):
    states, line, backbone = moved(at)
    basis = R.pod_basis(backbone, modes={"kappa_z": 1})
    fit = R.identify(states, basis, backbone, line, degree=1)
    return fit.section, fit.length, fit.elastic, fit.pressure


def condensed(at):
    states, line, backbone = moved(at)
    return R.condensed_stiffness(states, BASIS, line, samples=7, near=backbone)


FINGER = rod.rod(
    SE2(),
    rod.chebyshev(kappa_z=1, sigma_x=1),
    rod.circle(6e-3),
    length=0.1,
    young_modulus=1e5,
    poisson_ratio=0.3,
    density=1000.0,
    nodes=4,
)
TIMES = np.linspace(0.0, 0.1, 24)
SWING = np.stack([4 * np.cos(30 * TIMES), 0.02 * np.sin(90 * TIMES)], axis=1)
SWING = SWING * np.exp(-5 * TIMES)[:, None]


def damping(at):
    body, q, load = at
    fit = R.identify_damping(body, TIMES, q, (load,), window=9)
    return fit.damping, fit.error


def weight(at):
    problem = replace(path().problem, mesh=replace(BODY, points=at[0]), material=at[1])
    return R.offset_weight(problem, at[2], jnp.array([0.0, -9.81]))


PRESSURE = R.PressureMap(
    [[1e-5, 2e-6], [2e-6, -1e-5]], [[0.1, 0.2], [0.01, -0.02]], [1e-4, 2e-5], 3e3
)
STATE = jnp.array([3.0, -2.0])
CASES = {
    "strain_along": in_motion(lambda u: backbone(u).strain),
    "strain_along with an arm": in_motion(lambda u: backbone(u, arm=0.003).strain),
    "coordinates": in_motion(lambda u: R.coordinates(backbone(u), BASIS)),
    "mean_section": lambda: Case(section, path().problem.mesh.points, jit=False),
    "pod_basis, captured_energy": lambda: Case(modes, numbers(), step=1e-6, rtol=1e-6),
    "identify": lambda: Case(identified, numbers(), step=1e-4, rtol=1e-6),
    "condensed_stiffness": lambda: Case(condensed, numbers(), step=1e-4, rtol=1e-6),
    "identify_damping": lambda: Case(
        damping, (FINGER, jnp.asarray(SWING), rod.Gravity()), step=1e-5
    ),
    "offset_weight": lambda: Case(weight, (BODY.points, RUBBER, LINE)),
    "PressureMap": Case(
        lambda at: at[0].coenergy(at[1], at[2]), (PRESSURE, STATE, jnp.asarray(2e3))
    ),
}
