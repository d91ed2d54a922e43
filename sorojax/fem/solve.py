"""Equilibrium and load paths, differentiable in every number of the problem.

The derivative is that of the implicit function at the converged state: one more
back-substitution per direction, whatever steps the solver took to get there.
"""

import contextlib

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._progress import report
from sorojax._types import is_traced, real
from sorojax.fem.energy_form import residual
from sorojax.fem.follow import Log, Start, Stats, begin_at, follow
from sorojax.fem.linear import linearise, prepare
from sorojax.fem.newton import Newton
from sorojax.fem.problem import Problem
from sorojax.fem.supports import known_values
from sorojax.math import sparse
from sorojax.math.status import Status


class Solution(eqx.Module):
    """Displacement at equilibrium [m], or at the last converged fraction of the load."""

    problem: Problem
    displacement: Float[Array, "nodes dim"]
    status: Status
    stats: Stats = eqx.field(static=True)


class Path(eqx.Module):
    """Equilibria along a load path: `values` of the load `name`, one state for each."""

    problem: Problem
    displacements: Float[Array, "steps nodes dim"]
    values: Float[Array, "steps ..."]
    name: str = eqx.field(static=True)
    status: Status
    stats: tuple[Stats, ...] = eqx.field(static=True)

    def __len__(self) -> int:
        return self.displacements.shape[0]


class ConvergenceError(RuntimeError):
    """No equilibrium was found; `solution` holds the last converged state."""

    def __init__(self, message: str, solution: Solution):
        super().__init__(message)
        self.solution = solution


def solve(
    problem: Problem,
    *,
    start: Float[Array, "nodes dim"] | None = None,
    newton: Newton | None = None,
    steps: int = 1,
    max_cuts: int = 10,
    throw: bool = True,
) -> Solution:
    """Static equilibrium of `problem`.

    All loads and prescribed displacements grow together from zero, first in `steps` equal
    steps; a step that fails is cut in half, and steps grow again on easy ground. The
    answer does not depend on the steps unless the equilibrium is not unique.

    Args:
        problem: What to solve; differentiable in each of its numbers.
        start: Displacement to start from at full load, instead of stepping [m].
        newton: Tolerances; `Newton()` when omitted.
        steps: Number of equal load steps to try first.
        max_cuts: How often a step may be halved in a row.
        throw: Raise when no equilibrium is found, otherwise report it in `status`.

    Raises:
        ConvergenceError: If `throw` and a step failed after all cuts.
        ValueError: If called under `jit` or `vmap`.
    """
    newton = Newton() if newton is None else newton
    log = Log(newton, steps, max_cuts)
    u = _equilibrium(problem, None if start is None else np.asarray(start), log)
    solution = Solution(problem, u, log.status, log.stats())
    _raise_if_failed("fem.solve", solution, throw)
    return solution


def solve_path(
    problem: Problem,
    *,
    newton: Newton | None = None,
    max_cuts: int = 10,
    throw: bool = True,
    **values: Float[Array, "steps ..."],
) -> Path:
    """Equilibria for a row of values of one named load, the others held.

    `solve_path(problem, air=jnp.linspace(0, 20 * kPa, 21))` sets the load named "air".

    Args:
        problem: The problem; differentiable in each of its numbers.
        newton: Tolerances; `Newton()` when omitted.
        max_cuts: How often a step between two values may be halved in a row.
        throw: Raise when a value has no equilibrium, otherwise stop the path there.
        **values: One load by name, with one value per state.

    Raises:
        ConvergenceError: If `throw` and a step failed after all cuts.
        ValueError: If not exactly one existing load is named, or under `jit` or `vmap`.
    """
    name, row = _named_values(problem, values)
    log = Log(Newton() if newton is None else newton, 1, max_cuts)
    begin, states, stats = None, [], []
    for k, value in enumerate(row):
        target = with_load(problem, name, value)
        log.clear()
        u = _equilibrium(target, begin, log)
        stats.append(log.stats())
        if log.reason:
            solution = Solution(target, u, log.status, log.stats())
            _raise_if_failed("fem.solve_path", solution, throw)
            break
        states.append(u)
        begin = log.end
        report("equilibrium", k + 1, len(row), iterations=log.stats().iterations)
    shape = (0, *problem.mesh.points.shape)
    stacked = jnp.stack(states) if states else jnp.zeros(shape)
    return Path(problem, stacked, row[: len(states)], name, log.status, tuple(stats))


def _equilibrium(
    problem: Problem, begin: Start | np.ndarray | None, log: Log
) -> Float[Array, "nodes dim"]:
    """Displacement at equilibrium with the derivative of the implicit function.

    `begin` is a neighbouring equilibrium, a displacement at full load, or nothing (rest).
    """
    params, rest = eqx.partition(problem, eqx.is_inexact_array)

    @jax.custom_jvp
    def equilibrium(params):
        if is_traced(params):
            raise ValueError(
                "fem.solve: called under jit or vmap, need concrete numbers. Call it outside: "
                "its kernels are compiled already, and grad and jvp work without jit."
            )
        problem = eqx.combine(params, rest)
        with jax.core.eval_context():
            return jnp.asarray(follow(problem, begin_at(problem, begin), log))

    @equilibrium.defjvp
    def derivative(primals, tangents):
        u = equilibrium(*primals)
        return u, _tangent(rest, u, primals[0], tangents[0])

    return equilibrium(params)


def _tangent(rest, u, params, params_dot):
    """du of R(u, params) = 0, with prescribed displacements moving along."""
    problem = eqx.combine(params, rest)
    nodes, dim = u.shape

    def known(params):
        return known_values(eqx.combine(params, rest).supports, nodes, dim)

    def unbalanced(params, u):
        return residual(eqx.combine(params, rest), u).ravel()

    _, move = jax.jvp(known, (params,), (params_dot,))
    directions = (params_dot, move.reshape(u.shape))
    _, rhs = jax.jvp(unbalanced, (params, u), directions)
    # Concrete numbers run the programs that the solve compiled, not copies for the trace.
    concrete = not is_traced((params, u))
    with jax.core.eval_context() if concrete else contextlib.nullcontext():
        prepared = prepare(problem)
        values = linearise(problem, prepared, u, u).values
        matrix = sparse.fix(problem.space.system, values, prepared.known)
    rhs = jnp.where(prepared.known, jnp.zeros_like(rhs), -rhs)
    return (sparse.solve(problem.space.system, matrix, rhs) + move).reshape(u.shape)


def _named_values(problem: Problem, values: dict) -> tuple[str, Float[Array, "steps ..."]]:
    names = [load.name for load in problem.loads]
    if len(values) != 1 or next(iter(values)) not in names:
        raise ValueError(
            f"fem.solve_path: got values for {sorted(values)}, need exactly one of the loads "
            f"{names}. Name a load with `name=`."
        )
    name, row = next(iter(values.items()))
    row = real(row)
    _check.finite("fem.solve_path", name, row, "Use SI units: jnp.linspace(0, 20 * kPa, 21).")
    want = problem.loads[names.index(name)].value.shape
    if row.shape[1:] != want or not row.shape:
        raise ValueError(
            f"fem.solve_path: `{name}` has shape {row.shape}, need (steps, *{want})."
        )
    return name, row


def with_load(problem: Problem, name: str, value: Float[Array, "..."]) -> Problem:
    """`problem` with the load called `name` set to `value`."""
    index = [load.name for load in problem.loads].index(name)
    return eqx.tree_at(lambda p: p.loads[index].value, problem, value)


def _raise_if_failed(where: str, solution: Solution, throw: bool) -> None:
    if not throw or not solution.stats.reason:
        return
    stats = solution.stats
    done = stats.steps[-1].fraction if stats.steps else 0.0
    raise ConvergenceError(
        f"{where}: no equilibrium beyond {100 * done:.0f} % of the load after {stats.cuts} "
        f"cuts ({stats.reason}). Lower the load, refine the mesh where it deforms most, or "
        "pass throw=False for the last converged state.",
        solution,
    )
