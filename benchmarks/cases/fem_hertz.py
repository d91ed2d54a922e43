"""Elastic cylinder between rigid planes: force over approach, against theory."""

import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, measure_calls
from sorojax import fem, material, mesh, sdf
from sorojax.units import mm

NOTE = "Johnson, Contact Mechanics, 1985, section 5.6: a cylinder between two planes"
RADIUS, YOUNG, POISSON = 10 * mm, 1e5, 0.3
MODULUS = YOUNG / (1 - POISSON**2)
HALF_WIDTHS = np.array([0.2, 0.3, 0.4]) * mm


def cylinder(size: float, stiffness: float = 1.0) -> fem.Problem:
    """Quarter of a cylinder, held at mid-height, on a plane that rises; cells of `size` [m]
    where they touch. `stiffness` is that of the contact over its default."""
    quarter = sdf.Circle([0.0, 0.0], RADIUS) & sdf.Rectangle([0.0, -RADIUS], [RADIUS, 0.0])
    patch = sdf.Circle([0.0, -RADIUS], 1.2 * HALF_WIDTHS.max())
    sizes = mesh.grade(patch, near=size, far=RADIUS / 8, growth=0.25)

    def size_at(p):
        inside = np.linalg.norm(p - np.array([0.0, -RADIUS]), axis=1) < 1.2 * HALF_WIDTHS.max()
        return np.where(inside, size, sizes(p))

    cells = mesh.triangulate(quarter, size=size_at, order=2)

    def touching(p):
        return (jnp.abs(jnp.sum(p**2) / RADIUS**2 - 1) < 1e-3) & (p[1] < -0.9 * RADIUS)

    round_side = mesh.facets_where(cells, touching)
    problem = fem.problem(
        cells,
        material.neo_hookean(young_modulus=YOUNG, poisson_ratio=POISSON),
        kinematics=fem.PlaneStrain(1.0),
        supports=(
            fem.Fixed(mesh.nodes_where(cells, lambda p: p[0] < 1e-9), components=(0,)),
            fem.Fixed(mesh.nodes_where(cells, lambda p: p[1] > -1e-9), components=(1,)),
        ),
        loads=(
            fem.Contact(
                round_side,
                sdf.HalfPlane([0.0, -RADIUS], [0.0, 1.0]),
                10 * stiffness * YOUNG / size,
                name="plane",
            ),
        ),
    )
    return problem


def approach(force):
    """Approach [m] of a plane and the axis under a force per depth [N/m]."""
    half_width = np.sqrt(4 * force * RADIUS / (np.pi * MODULUS))
    return force / (np.pi * MODULUS) * (2 * np.log(4 * RADIUS / half_width) - 1)


def forces_at(half_widths):
    """Force per depth [N/m] at half-widths of contact [m]."""
    return np.pi * MODULUS * np.asarray(half_widths) ** 2 / (4 * RADIUS)


def found_forces(problem: fem.Problem, approaches):
    """Force per depth of the whole cylinder [N/m] where the plane has risen by so much, and
    the largest overlap [m]."""
    rows = jnp.stack([jnp.array([0.0, 1.0]) * rise for rise in approaches])
    path = fem.solve_path(problem, plane=rows)
    states = [
        fem.contact_state(fem.with_load(problem, "plane", value), u, "plane")
        for value, u in zip(rows, path.displacements, strict=True)
    ]
    forces = np.array([2 * float(state.total[1]) for state in states])
    return forces, max(float(state.penetration) for state in states), path


def rows():
    wanted = forces_at(HALF_WIDTHS)
    rises = approach(wanted)
    for size, stiffness in ((0.06 * mm, 1.0), (0.03 * mm, 1.0), (0.03 * mm, 2.0)):
        problem = cylinder(size, stiffness)
        timing = measure_calls(lambda p=problem: found_forces(p, rises)[0], repeats=3)
        forces, overlap, path = found_forces(problem, rises)
        errors = forces / wanted - 1
        settings = {
            "dof": problem.space.num_dofs,
            "size_mm": size / mm,
            "stiffness_over_default": stiffness,
            "iterations": [stats.iterations for stats in path.stats],
            "errors": np.round(errors, 4).tolist(),
            "overlap_over_approach": round(overlap / float(rises[-1]), 5),
        }
        yield Row(
            "sorojax",
            settings,
            **timing.columns(),
            reference=NOTE,
            error=float(np.abs(errors).max()),
            bar=0.02,
            bar_on="error",
        )
