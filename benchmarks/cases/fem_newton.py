"""One Newton iteration end to end and where its time goes, against felupe."""

from itertools import count
from statistics import median

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import peers
from benchmarks.blocks import bent, block, cpu_timing, merged, softened
from benchmarks.harness import Row, Timing, missing
from sorojax import fem, mesh
from sorojax.fem.equilibrium.linear import constrain, linearise, prepare
from sorojax.fem.problem import load_force

#: Element, cells a side and how many times faster than felupe it should be.
CASES = (
    (mesh.Quad4(), (112, 112), 5.0),
    (mesh.Quad4(), (226, 226), 5.0),
    (mesh.Hex8(), (25, 25, 27), 2.5),
)
WORKERS = 1  # solves are on the host, nothing compiled calls it
ITERATIONS = 4
ROUNDS = 3


def rows():
    for element, divisions, bar in CASES:
        problem = block(element, divisions, fem.Displacement())
        ours, peer = [], []
        for _ in range(ROUNDS):  # in turns, so that both meet the same machine
            ours.append(_solve(problem))
            peer.append(_felupe(problem))
        timing = merged(*ours)
        settings = _settings(problem)
        if isinstance(peer[0], str):
            yield Row("sorojax", settings, **timing.columns())
            yield missing("felupe", peer[0], **settings)
        else:
            runs = sorted(run for answer, _ in peer for run in answer["runs"])
            told = {key: peer[0][0][key] for key in ("version", "solver")}
            u, found = fem.solve(problem).displacement, peer[0][1]["displacement"]
            faster = {
                "faster_than_felupe": median(runs) / median(timing.runs),
                "fastest_of_each": min(runs) / min(timing.runs),
            }
            yield Row(
                "sorojax",
                settings | faster,
                **timing.columns(),
                bar=median(runs) / bar,
                error=float(jnp.max(jnp.abs(u - found)) / jnp.max(jnp.abs(u))),
                reference=f"felupe after {ITERATIONS} iterations",
            )
            yield Row("felupe", settings | told, 0.0, median(runs), runs[0], runs[-1])
        yield from _parts(problem, settings)


def _settings(problem: fem.Problem) -> dict:
    return {
        "element": problem.mesh.element.name,
        "dof": problem.space.num_dofs,
        "clock": "CPU time per iteration",
        "solver": problem.space.system.solver.name,
    }


def _solve(problem: fem.Problem) -> Timing:
    """Whole solves, over their iterations: the state at rest is linearised once more."""
    iterations, others = fem.solve(problem).stats.iterations, softened(problem)
    return cpu_timing(lambda: fem.solve(next(others)).displacement, 3).per(iterations)


def _felupe(problem: fem.Problem):
    """Answer and arrays of felupe, or the reason why there are none."""
    rubber, dim = problem.material, problem.mesh.element.dim
    zero = jnp.zeros_like(problem.mesh.points)
    fixed = np.asarray(problem.supports[0].nodes)
    arrays = {
        "points": np.asarray(problem.mesh.points),
        "cells": np.asarray(problem.mesh.cells),
        "fixed": (fixed[:, None] * dim + np.arange(dim)).ravel(),
        "force": np.asarray(load_force(problem, zero)),
    }
    try:
        return peers.call(
            "felupe",
            "newton",
            arrays,
            element=problem.mesh.element.name,
            repeats=2,
            iterations=ITERATIONS,
            mu=float(rubber.shear_modulus),  # type: ignore
            bulk=float(rubber.bulk_modulus),  # type: ignore
        )
    except peers.PeerMissing as reason:
        return str(reason)


def _parts(problem: fem.Problem, settings: dict):
    """The profile: each part of an iteration by itself."""
    prepared = prepare(problem)
    u = bent(problem.mesh.points)
    state = jax.block_until_ready(linearise(problem, prepared, u, u))
    zero = jnp.zeros_like(state.residual)
    system = problem.space.system

    def held():
        return constrain(system, state.values, state.residual, prepared.known, zero)

    matrix, rhs = map(np.asarray, held())
    factor = system.solver.factor(matrix)
    number = count(1)
    parts = {
        "assembly": lambda: linearise(problem, prepared, u, u),
        "supports": held,
        # other values every time: factors of known values are kept
        "factor": lambda: system.solver.factor(matrix * (1 + 1e-9 * next(number))),
        "solve": lambda: factor.solve(rhs),  # type: ignore
        "preparation, once a solve": lambda: prepare(problem).geometry,
    }
    for name, call in parts.items():
        yield Row("sorojax", settings | {"part": name}, **cpu_timing(call, 5).columns())
