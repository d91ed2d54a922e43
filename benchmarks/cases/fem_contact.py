"""Rigid cylinder on an elastic block in plane strain, against the contact of Hertz."""

import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, measure_calls
from benchmarks.manufactured import NodalForces
from sorojax import fem, material, mesh, sdf
from sorojax.contact.facet import Contacts
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
    half_width = float(np.sqrt(4 * force * RADIUS / (np.pi * MODULUS)))
    return half_width, 2 * force / (np.pi * half_width)


def own_half_width(state: Contacts) -> float:
    """Half-width [m] of the ellipse of pressure with the second moment of the found one."""
    force, x = np.asarray(state.force[:, 1]), np.asarray(state.position[:, 0])
    return 2 * float(np.sqrt(np.sum(force * x**2) / np.sum(force)))


def block_approach(problem: fem.Problem, force: float) -> float:
    """Sink [m] of the middle of this very block under the pressure of Hertz, of which the
    law of contact knows nothing; a half-space would sink without limit."""
    half_width, peak = hertz(force)
    line = np.sort(np.asarray(problem.mesh.points)[problem.mesh.node_sets["top"], 0])
    x = np.linspace(0, half_width, 4001)
    middle, width = (x[1:] + x[:-1]) / 2, x[1]
    hats = np.stack([np.interp(middle, line, row) for row in np.eye(len(line))])
    amount = hats @ (peak * np.sqrt(1 - (middle / half_width) ** 2) * width)
    forces = np.zeros(problem.mesh.points.shape)
    top = np.asarray(problem.mesh.node_sets["top"])
    order = np.argsort(np.asarray(problem.mesh.points)[top, 0])
    forces[top[order], 1] = -amount
    pressed = fem.problem(
        problem.mesh,
        problem.material,
        kinematics=problem.kinematics,
        supports=problem.supports,
        loads=(NodalForces(forces),),
    )
    sunk = fem.solve(pressed).displacement
    return -float(sunk[mesh.nearest_node(problem.mesh, [0.0, 0.0]), 1])


def rows():
    for divisions in (24, 48):
        problem = pressed_block(divisions)
        moves = jnp.stack([jnp.array([0.0, -approach]) for approach in APPROACHES])

        def solve(problem=problem, moves=moves):
            return fem.solve_path(problem, cylinder=moves)

        timing = measure_calls(lambda: solve().displacements, repeats=3)
        path = solve()
        pressed = fem.with_load(problem, "cylinder", moves[-1])
        state = fem.contact_state(pressed, path.displacements[-1], "cylinder")
        force = -2 * float(state.total[1])
        half_width, peak = hertz(force)
        settings = {
            "dof": problem.space.num_dofs,
            "iterations": [stats.iterations for stats in path.stats],
            "cuts": sum(stats.cuts for stats in path.stats),
            "force_N_per_m": round(force, 4),
            "half_width_error": round(own_half_width(state) / half_width - 1, 4),
            "approach_error": round(APPROACHES[-1] / block_approach(problem, force) - 1, 4),
        }
        error = abs(float(state.pressure.max()) / peak - 1)
        bar = 0.02 if divisions == 48 else None
        yield Row(
            "sorojax",
            settings,
            **timing.columns(),
            reference=NOTE,
            error=error,
            bar=bar,
            bar_on="error",
        )
