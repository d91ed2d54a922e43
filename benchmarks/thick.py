"""Thick tubes and spheres of neo-Hookean rubber under inner pressure.

Inner radius 1, outer radius 2, shear modulus 1; the tube is held in length. The reference is
the radial boundary value problem of the same compressible material, by shooting.
"""

from functools import partial

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from sorojax import fem, material, mesh
from sorojax.mesh import Mesh

INNER, OUTER = 1.0, 2.0


def inner_displacement(num_hoops: int, bulk: float, pressure: float) -> float:
    """Radial displacement of the inner wall: one hoop direction in a tube, two in a sphere.

    P_r' + m (P_r - P_t) / R = 0 for m hoops, with P_r = -p (r / R)^m inside and 0 outside.
    Unknowns are r and P_r; the radial stretch follows from P_r by Newton's method.
    """
    m = num_hoops

    def stresses(radial, hoop):
        J = radial * hoop**m
        first = radial**2 + hoop**2 * m + (2 - m)
        a = J ** (-2 / 3)

        def stress(stretch):
            return a * (stretch - first / (3 * stretch)) + bulk * (J - 1) * J / stretch

        P = stress(radial)
        shape = radial - first / (3 * radial)
        slope = a * (1 / 3 + first / (3 * radial**2)) - 2 * a / (3 * radial) * shape
        return P, stress(hoop), slope + bulk * (J / radial) ** 2

    def radial_stretch(P, hoop):
        radial = hoop**-m
        for _ in range(50):
            value, _, slope = stresses(radial, hoop)
            step = (P - value) / slope
            radial += step
            if abs(step) < 1e-15:
                break
        return radial

    def rates(R, y):
        r, P = y
        hoop = r / R
        radial = radial_stretch(P, hoop)
        return [radial, m * (stresses(radial, hoop)[1] - P) / R]

    def outer_stress(u):
        hoop = 1 + u / INNER
        start = [INNER + u, -pressure * hoop**m]
        end = solve_ivp(rates, (INNER, OUTER), start, "DOP853", rtol=1e-13, atol=1e-14)
        return end.y[1, -1]

    return brentq(outer_stress, 1e-6, 0.6, xtol=1e-14, rtol=1e-14)  # type: ignore


def incompressible_displacement(num_hoops: int, pressure: float) -> float:
    """The same without change of volume, in closed form."""
    m = num_hoops + 1

    def excess(u):
        a = 1 + u / INNER
        b = (1 + (INNER / OUTER) ** m * (a**m - 1)) ** (1 / m)
        if num_hoops == 1:
            return np.log(a / b) + (b**-2 - a**-2) / 2 - pressure
        return 2 / b + 1 / (2 * b**4) - 2 / a - 1 / (2 * a**4) - pressure

    return brentq(excess, 0.0, 0.6, xtol=1e-14)  # type: ignore


def quarter(element: mesh.AbstractElement, divisions: tuple[int, int]) -> Mesh:
    """A quarter of a ring, every node of the cells on its circle: cells along the radius,
    then along the angle. Sets "left" (inner), "right" (outer), "bottom" and "top"."""
    upper = [OUTER, np.pi / 2]
    grid = mesh.rectangle([INNER, 0], upper, divisions=divisions, element=element)
    R, angle = grid.points[:, 0], grid.points[:, 1]
    X = jnp.stack([R * jnp.cos(angle), R * jnp.sin(angle)], axis=1)
    X = jnp.where(jnp.abs(X) < 1e-12, jnp.zeros_like(X), X)
    return Mesh(X, grid.cells, grid.element, grid.node_sets, grid.facet_sets)


def _body(kinematics, cells: Mesh, bulk, pressure, space=None, formulation=None):
    return fem.problem(
        cells,
        material.NeoHookean(1.0, bulk),
        kinematics=kinematics,
        supports=(
            fem.Fixed(cells.node_sets["bottom"], components=(1,)),
            fem.Fixed(cells.node_sets["top"], components=(0,)),
        ),
        loads=(fem.Pressure(cells.facet_sets["left"], pressure),),
        formulation=formulation,
        space=space,
    )


tube = partial(_body, fem.PlaneStrain(1.0))
sphere = partial(_body, fem.Axisymmetric())


def straight_tube(cells: Mesh, bulk, pressure, space=None, formulation=None) -> fem.Problem:
    """The tube as a body of revolution, between two planes: a straight piece of its wall."""
    ends = np.union1d(cells.node_sets["bottom"], cells.node_sets["top"])
    return fem.problem(
        cells,
        material.NeoHookean(1.0, bulk),
        kinematics=fem.Axisymmetric(),
        supports=(fem.Fixed(ends, components=(1,)),),
        loads=(fem.Pressure(cells.facet_sets["left"], pressure),),
        formulation=formulation,
        space=space,
    )


def wall_displacement(problem: fem.Problem, solution: fem.Solution) -> float:
    """Radial displacement of the inner wall where it meets the plane y = 0."""
    node = mesh.nearest_node(problem.mesh, [INNER, 0.0])
    return float(solution.displacement[node, 0])
