"""Rigid cylinder on an elastic block in plane strain, against the contact of Hertz."""

import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, measure_calls
from sorojax import fem, material, mesh, sdf
from sorojax.units import mm

NOTE = "Hertz, line contact on a half-space at the computed force"
RADIUS, SIDE = 50 * mm, 20 * mm
YOUNG, POISSON = 1e5, 0.3
APPROACHES = (0.05 * mm, 0.1 * mm)


def pressed_block(divisions: int) -> fem.Problem:
    """Half of a block of 40 x 20 mm under a cylinder, cells graded towards the contact."""
    block = mesh.rectangle(
        [0, -SIDE], [SIDE, 0], divisions=(divisions, divisions), element=mesh.Quad4()
    )
    points = np.asarray(block.points) / SIDE
    graded = SIDE * np.sign(points) * np.abs(points) ** 2
    block = mesh.Mesh(graded, block.cells, block.element, block.node_sets, block.facet_sets)
    return fem.problem(
        block,
        material.neo_hookean(young_modulus=YOUNG, poisson_ratio=POISSON),
        kinematics=fem.PlaneStrain(1.0),
        supports=(
            fem.Fixed(block.node_sets["bottom"]),
            fem.Fixed(block.node_sets["left"], components=(0,)),
        ),
        loads=(
            fem.Contact(
                block.facet_sets["top"],
                sdf.Circle([0.0, RADIUS], RADIUS),
                1e2 * YOUNG / mm,
                name="cylinder",
            ),
        ),
    )


MODULUS = YOUNG / (1 - POISSON**2)


def hertz(force: float) -> tuple[float, float]:
    """Half-width [m] and peak pressure [Pa] under a force per depth [N/m].

    Reference: Johnson, Contact Mechanics, 1985, section 4.2.
    """
    half_width = np.sqrt(4 * force * RADIUS / (np.pi * MODULUS))
    return half_width, 2 * force / (np.pi * half_width)


def approach_ratio(first: float, second: float) -> float:
    """Approach at the second force by the law force (constant - 2 log half-width), with the
    constant, which depends on the block, from the first; over the prescribed one."""
    constant = APPROACHES[0] * np.pi * MODULUS / first + 2 * np.log(hertz(first)[0])
    slope = (constant - 2 * np.log(hertz(second)[0])) / (np.pi * MODULUS)
    return second * slope / APPROACHES[1]


def rows():
    for divisions in (24, 48):
        problem = pressed_block(divisions)
        moves = jnp.stack([jnp.array([0.0, -approach]) for approach in APPROACHES])

        def solve(problem=problem, moves=moves):
            return fem.solve_path(problem, cylinder=moves)

        timing = measure_calls(lambda: solve().displacements, repeats=3)
        path = solve()
        states = [
            fem.contact_state(fem.with_load(problem, "cylinder", move), u, "cylinder")
            for move, u in zip(moves, path.displacements, strict=True)
        ]
        first, force = (-2 * float(state.total[1]) for state in states)
        half_width, peak = hertz(force)
        state = states[-1]
        touching = float(jnp.max(jnp.where(state.active, state.position[:, 0], 0.0)))
        settings = {
            "dof": problem.space.num_dofs,
            "iterations": sum(stats.iterations for stats in path.stats),
            "cuts": sum(stats.cuts for stats in path.stats),
            "force_N_per_m": round(force, 4),
            "half_width_error": round(touching / half_width - 1, 4),
            "approach_error": round(approach_ratio(first, force) - 1, 4),
        }
        error = abs(float(state.pressure.max()) / peak - 1)
        yield Row("sorojax", settings, **timing.columns(), reference=NOTE, error=error,
                  bar=0.05, bar_on="error")  # fmt: skip
