"""Conjugate gradients with multigrid against the direct solver.

Linear systems, iterations by size and Poisson ratio, and whole solves, in CPU time. On a CPU
the direct solver is the one to take; the iterative one is for accelerators and for sizes
whose factors do not fit.
"""

import dataclasses
from itertools import count

import jax.numpy as jnp
import numpy as np

from benchmarks import cook
from benchmarks.bellows import PRESSURES, case_a
from benchmarks.blocks import bent, block, cpu_timing, softened
from benchmarks.harness import Row, quick
from sorojax import fem, mesh
from sorojax.fem.equilibrium.linear import constrain, linearise, prepare
from sorojax.math.linalg import sparse
from sorojax.units import mm

#: Element and cells a side of the systems that are timed, and of those that are counted.
TIMED = ((mesh.Quad4(), 158), (mesh.Hex8(), 26))
COUNTED = (
    (mesh.Quad4(), (20, 40, 160)),
    (mesh.Tri6(), (10, 20, 80)),
    (mesh.Hex8(), (7, 13, 26)),
    (mesh.Tet10(), (4, 8, 12)),
)
POISSON_RATIOS = (0.45, 0.49, 0.499)


def rows():
    for element, side in TIMED:
        yield from _systems(element, side // 4 if quick() else side)
    for element, sides in COUNTED:
        for side in sides[:2] if quick() else sides:
            yield _counted(element, side, 0.45)
    for ratio in POISSON_RATIOS:
        yield _counted(mesh.Quad4(), 40, ratio)
        yield _counted(mesh.Hex8(), 10, ratio)
    yield from _solves("Cook's membrane", cook.plane_panel(mesh.Quad4(), 32, 0.49))
    yield from _solves("block", block(mesh.Hex8(), (6 if quick() else 26,) * 3))
    yield from _path(case_a((2.2 if quick() else 1.1) * mm))


def iterating(problem: fem.Problem) -> fem.Problem:
    """`problem` with the iterative solver."""
    space = fem.space(problem.mesh, problem.loads, "conjugate_gradient")
    return dataclasses.replace(problem, space=space)


def _tangent(problem: fem.Problem, u):
    """Tangent at `u` with its supports, and the unbalanced force."""
    prepared = prepare(problem)
    state = linearise(problem, prepared, u, u)
    still = jnp.zeros_like(state.residual)
    held = constrain(problem.space.system, state.values, state.residual, prepared.known, still)
    return tuple(np.asarray(x) for x in held)


def _systems(element: mesh.AbstractElement, side: int):
    """One system of a bent block: levels or factor, and a solution."""
    problem = block(element, (side,) * element.dim, fem.Displacement())
    matrix, rhs = _tangent(problem, bent(problem.mesh.points))
    settings = {"element": element.name, "dof": problem.space.num_dofs, "clock": "CPU time"}
    exact = None
    for solver in (problem, iterating(problem)):
        system, number = solver.space.system, count(1)
        settings |= {"solver": system.means, "part": "factor or levels"}

        def fresh(system=system, number=number):
            # other values every time: factors of known values are kept
            found = system.solver.factor(matrix * (1 + 1e-9 * next(number)))
            return found.levels if isinstance(found, sparse.IterativeFactor) else None

        yield Row("sorojax", dict(settings), **cpu_timing(fresh, 3).columns())
        factor = system.solver.factor(matrix)
        assert factor is not None
        timing, x = cpu_timing(lambda f=factor: f.solve(rhs), 3), factor.solve(rhs)
        settings["part"] = "solution"
        if exact is None:
            exact = x
            yield Row("sorojax", dict(settings), **timing.columns())
            continue
        assert isinstance(factor, sparse.IterativeFactor)
        told = settings | {"iterations": factor.count(rhs)}
        error = float(np.max(np.abs(x - exact)) / np.max(np.abs(exact)))
        yield Row(
            "sorojax",
            told,
            **timing.columns(),
            error=error,
            reference="direct solver",
            bar=1e-8,
            bar_on="error",
        )
        rough = sparse.ConjugateGradient().newton_tolerance
        told |= {"part": "Newton step", "iterations": factor.count(rhs, rough)}
        timing = cpu_timing(lambda f=factor: f.step(rhs), 3)
        yield Row("sorojax", told, **timing.columns())


def _counted(element: mesh.AbstractElement, side: int, ratio: float) -> Row:
    """Iterations for a random force on the block at rest."""
    formulation = fem.Displacement() if ratio == 0.45 else None
    problem = iterating(block(element, (side,) * element.dim, formulation, ratio))
    matrix, rhs = _tangent(problem, jnp.zeros_like(problem.mesh.points))
    force = np.random.default_rng(0).standard_normal(rhs.shape)
    force[np.asarray(prepare(problem).known)] = 0.0
    factor = problem.space.system.solver.factor(matrix)
    settings = {
        "element": element.name,
        "dof": problem.space.num_dofs,
        "poisson_ratio": ratio,
        "formulation": type(problem.formulation).__name__,
        "levels": len(problem.space.system.iterative.maps.levels) + 1,  # type: ignore
        "iterations": factor.count(force, 1e-8),  # type: ignore
        "tolerance": 1e-8,
    }
    return Row("sorojax", settings)


def _solves(name: str, problem: fem.Problem):
    """Whole solves: how long they take and that they agree."""
    exact = fem.solve(problem)
    for solver in (problem, iterating(problem)):
        found = fem.solve(solver)
        error = float(
            jnp.max(jnp.abs(found.displacement - exact.displacement))
            / jnp.max(jnp.abs(exact.displacement))
        )
        again = softened(solver)
        timing = cpu_timing(lambda p=again: fem.solve(next(p)).displacement, 2)
        settings = {
            "problem": name,
            "dof": problem.space.num_dofs,
            "newton_iterations": found.stats.iterations,
            "solver": solver.space.system.means,
        }
        yield Row(
            "sorojax",
            settings,
            **timing.columns(),
            error=error,
            reference="direct solver",
            bar=1e-9,
            bar_on="error",
        )


def _path(problem: fem.Problem):
    """The bellows actuator from 0 to 20 kPa: thin walls, the hard case of multigrid."""
    name, exact = problem.loads[0].name, None
    for solver in (problem, iterating(problem)):

        def follow(share=1.0, problem=solver):
            pressures = {name: share * jnp.asarray(PRESSURES)}
            return fem.solve_path(problem, **pressures)  # type: ignore

        found, number = follow(), count(1)
        exact = found.displacements if exact is None else exact
        error = float(jnp.max(jnp.abs(found.displacements - exact)) / jnp.max(jnp.abs(exact)))
        timing = cpu_timing(lambda f=follow, n=number: f(1 - 1e-6 * next(n)).displacements, 1)
        settings = {
            "problem": "bellows",
            "dof": problem.space.num_dofs,
            "newton_iterations": sum(stats.iterations for stats in found.stats),
            "solver": solver.space.system.means,
        }
        yield Row(
            "sorojax",
            settings,
            **timing.columns(),
            error=error,
            reference="direct solver",
            bar=1e-9,
            bar_on="error",
        )
