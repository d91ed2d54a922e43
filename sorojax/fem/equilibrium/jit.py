"""Following an equilibrium inside a trace: the rules of `follow` and `newton` as one loop.

Every pass of the loop assembles once and does one thing: accept the load level, cut it,
shorten the last move or take a Newton step with the direct solver behind a callback.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sorojax._jax.trace_state import is_traced
from sorojax.fem.assembly import assemble as asm
from sorojax.fem.assembly.assemble import cell_matrices
from sorojax.fem.assembly.geometry import geometry
from sorojax.fem.assembly.space import Space
from sorojax.fem.equilibrium.linear import Linearised, Prepared, constrain, linearise, prepare
from sorojax.fem.equilibrium.load_stepping import between, unloaded
from sorojax.fem.equilibrium.newton import Newton, overshoots, share_of_step
from sorojax.fem.problem import Problem
from sorojax.fem.supports import known_components, known_values
from sorojax.material.hyperelastic import finite_share
from sorojax.math.linalg import sparse


class Begin(NamedTuple):
    """Where to start from: a displacement [m], the loads and supports it balances (those of
    the problem itself when `None`) and the values of the tangent there, if known."""

    u: Float[Array, "nodes dim"]
    terms: tuple | None = None
    tangent: Float[Array, " nnz"] | None = None


class Outcome(NamedTuple):
    """Displacement, tangent values there (empty unless asked for), and as floats, so that
    one rule serves every output: failed or not, fraction of the load, iterations, cuts and
    load steps."""

    u: Float[Array, "nodes dim"]
    counts: Float[Array, " 5"]
    tangent: Float[Array, " nnz"]


class _State(NamedTuple):
    """`u` is the trial, `start` the last equilibrium, at the fraction `done` of the load."""

    u: Float[Array, "nodes dim"]
    before: Float[Array, "nodes dim"]
    start: Float[Array, "nodes dim"]
    tangent: Float[Array, " nnz"]
    predict: Bool[Array, ""]
    moved: Bool[Array, ""]
    shortened: Bool[Array, ""]
    update: Float[Array, ""]
    done: Float[Array, ""]
    goal: Float[Array, ""]
    step: Float[Array, ""]
    iterations: Int[Array, ""]
    total: Int[Array, ""]
    levels: Int[Array, ""]
    cuts: Int[Array, ""]
    failures: Int[Array, ""]
    running: Bool[Array, ""]


class _Level(NamedTuple):
    """What one pass found at the trial state; exactly one of the first four is true."""

    collapsed: Bool[Array, ""]
    converged: Bool[Array, ""]
    failed: Bool[Array, ""]
    stepped: Bool[Array, ""]
    usable: Bool[Array, ""]
    du: Float[Array, "nodes dim"]
    values: Float[Array, " nnz"]


def prepare_traced(problem: Problem) -> Prepared:
    """`linear.prepare` for a problem whose node numbers may be traced as well."""
    mesh, dim = problem.mesh, problem.mesh.element.dim
    known = known_mask(problem.supports, mesh.num_nodes, dim)
    parts = [load.curved_part(problem) for load in problem.loads]
    slots = tuple(_slots(problem.space.system, p.groups, dim) for p in parts if p is not None)
    shape = geometry(problem.space, problem.kinematics, problem.formulation, mesh.points)
    length = jnp.max(jnp.ptp(mesh.points[mesh.cells], axis=1))
    return Prepared(shape, known, length, slots)


def known_mask(supports: tuple, num_nodes: int, dim: int) -> Bool[Array, " dofs"]:
    """`known_dofs` where node numbers may be traced."""
    known = jnp.zeros((num_nodes, dim), bool)
    for support in supports:
        for component in known_components(support, dim):
            known = known.at[support.nodes, component].set(True)
    return known.ravel()


def _slots(system: sparse.SparseSymmetric, groups, dim: int):
    dofs = (groups[:, :, None] * dim + jnp.arange(dim, dtype=groups.dtype)[None, None]).astype(
        jnp.int64
    )
    dofs = dofs.reshape(len(groups), -1)
    first, second = jnp.triu_indices(dofs.shape[1])
    low = jnp.minimum(dofs[:, first], dofs[:, second])
    high = jnp.maximum(dofs[:, first], dofs[:, second])
    keys = system.rows.astype(jnp.int64) * system.size + system.cols.astype(jnp.int64)
    return jnp.searchsorted(keys, low * system.size + high).astype(jnp.int32)


def follow_traced(
    problem: Problem,
    begin: Begin | None,
    newton: Newton,
    steps: int,
    max_cuts: int,
    prepared: Prepared | None = None,
) -> Outcome:
    """Step from `begin` to `problem`, halving steps that fail; every number may be traced."""
    first = _first(problem, begin)
    prepared = prepare_traced(problem) if prepared is None else prepared
    state = _initial(problem, begin, steps)

    def one_pass(state: _State) -> _State:
        here = between(first, problem, state.goal)  # pyright: ignore[reportArgumentType]
        level = _examine(here, prepared, state, newton)
        return _next(problem, prepared, state, level, max_cuts)

    end = jax.lax.while_loop(lambda state: state.running, one_pass, state)
    numbers = (end.done < 1.0, end.done, end.total, end.cuts, end.levels)
    counts = jnp.stack([jnp.asarray(n, end.u.dtype) for n in numbers])
    return Outcome(end.start, counts, end.tangent)


def _first(problem: Problem, begin: Begin | None) -> Problem:
    if begin is None:
        return unloaded(problem)
    return problem if begin.terms is None else with_terms(problem, begin.terms)


def with_terms(problem: Problem, terms: tuple) -> Problem:
    """`problem` under other loads and supports."""
    loads, supports = terms
    return eqx.tree_at(lambda p: (p.loads, p.supports), problem, (loads, supports))


def _initial(problem: Problem, begin: Begin | None, steps: int) -> _State:
    points = problem.mesh.points
    u = jnp.zeros_like(points) if begin is None else jnp.asarray(begin.u, points.dtype)
    tangent = None if begin is None else begin.tangent
    predict = jnp.asarray(tangent is not None and _smooth(problem))
    if tangent is None:
        tangent = jnp.zeros(problem.space.system.num_values, points.dtype)
    false, zero = jnp.asarray(False), jnp.zeros((), points.dtype)
    none, step = jnp.asarray(0, jnp.int32), jnp.asarray(1.0 / steps, points.dtype)
    return _State(
        u=u, before=u, start=u, tangent=tangent, predict=predict, moved=false, shortened=false,
        update=zero + jnp.inf, done=zero, goal=_goal(zero, step), step=step,
        iterations=none, total=none, levels=none, cuts=none, failures=none,
        running=jnp.all(jnp.isfinite(u)),
    )  # fmt: skip


def _smooth(problem: Problem) -> bool:
    return all(load.smooth for load in problem.loads)


def _goal(done, step):
    return jnp.where(done + step < 1.0 - 1e-9, done + step, jnp.ones_like(done))


def _examine(here: Problem, prepared: Prepared, state: _State, newton: Newton) -> _Level:
    """Judge the trial state and, where it is worth it, find the Newton step from there."""
    found = linearise(here, prepared, state.u, state.before)
    wanted = known_values(here.supports, *state.u.shape)
    move = jnp.where(prepared.known, wanted - state.u.ravel(), jnp.zeros_like(wanted))
    tiny = jnp.abs(move) <= 1e-12 * jnp.max(jnp.abs(wanted))
    move = jnp.where(state.moved & tiny, jnp.zeros_like(move), move)
    collapsed = state.moved & ~state.shortened & ~(found.volume_ratio > 0.1)
    valid = jnp.isfinite(found.residual_norm) & (found.volume_ratio > 0)
    small = _is_small(found, newton) & (state.update < newton.step_tolerance)
    converged = ~collapsed & valid & small & ~state.predict & ~jnp.any(move != 0)
    exhausted = (state.iterations >= newton.max_iterations) & ~state.predict
    failed = ~collapsed & ~converged & (~valid | exhausted)
    values = jnp.where(state.predict, state.tangent, found.values)

    def direction():
        system = here.space.system
        matrix, rhs = constrain(system, values, found.residual, prepared.known, move)
        x, negative = sparse.solve_with_inertia(system, matrix, rhs)
        usable = negative >= 0
        du = jnp.where(usable, x + move, jnp.zeros_like(x))
        return du.reshape(state.u.shape), usable

    def nothing():
        return jnp.zeros_like(state.u), jnp.asarray(True)

    seek = ~(collapsed | converged | failed)
    du, usable = jax.lax.cond(seek, direction, nothing)
    if overshoots(here):
        share = share_of_step(here, prepared.known, found.residual, state.u, du)
        free = seek & ~state.predict & ~jnp.any(move != 0)
        du = jnp.where(free, share, jnp.ones_like(share)) * du
    # a singular tangent ends the level, except that of the first guess
    failed = failed | (seek & ~usable & ~state.predict)
    return _Level(collapsed, converged, failed, seek & ~failed, usable, du, found.values)


def _is_small(found: Linearised, newton: Newton):
    loaded = found.reference > 0
    scale = jnp.where(loaded, found.reference, jnp.ones_like(found.reference))
    ratio = found.residual_norm / scale
    return (ratio < newton.residual_tolerance) | (found.residual_norm < found.rounding)


def _next(problem, prepared, state: _State, level: _Level, max_cuts: int) -> _State:
    def shorter():
        du = state.u - state.before
        args = (problem.space, prepared.geometry, problem.kinematics, state.before, du)
        share = finite_share(problem.material)
        return state.before + 0.9 * asm.largest_step(*args, share=share) * du

    short = jax.lax.cond(level.collapsed, shorter, lambda: state.u)
    new = state.u + level.du
    scale = jnp.max(jnp.abs(new)) + 1e-9 * prepared.length
    update = jnp.max(jnp.abs(level.du)) / scale
    update = jnp.where(level.usable, update, jnp.full_like(update, jnp.inf))
    moved = state._replace(
        u=new, before=state.u, predict=jnp.asarray(False), moved=jnp.asarray(True),
        shortened=jnp.asarray(False), update=update,
        iterations=state.iterations + jnp.where(state.predict, 0, 1).astype(jnp.int32),
    )  # fmt: skip
    shortened = state._replace(u=short, shortened=jnp.asarray(True))
    branches = (
        (level.stepped, moved),
        (level.collapsed, shortened),
        (level.converged, _accepted(state, level, _smooth(problem))),
        (level.failed, _cut(state, max_cuts)),
    )
    chosen = state
    for taken, branch in branches:
        chosen = jax.tree.map(lambda a, b, taken=taken: jnp.where(taken, b, a), chosen, branch)
    return chosen


def _accepted(state: _State, level: _Level, smooth: bool) -> _State:
    step = jnp.where(state.iterations <= 5, 1.5 * state.step, state.step)
    state = state._replace(
        before=state.u, start=state.u, tangent=level.values, done=state.goal, step=step,
        predict=jnp.asarray(smooth),
        goal=_goal(state.goal, step), total=state.total + state.iterations,
        levels=state.levels + 1,
        failures=jnp.zeros_like(state.failures), running=state.goal < 1.0,
    )  # fmt: skip
    return _fresh(state)


def _cut(state: _State, max_cuts: int) -> _State:
    step, failures = (state.goal - state.done) / 2, state.failures + 1
    state = state._replace(
        u=state.start, before=state.start, step=step, goal=_goal(state.done, step),
        predict=jnp.asarray(False), failures=failures,
        cuts=state.cuts + 1, running=failures <= max_cuts,
    )  # fmt: skip
    return _fresh(state)


def _fresh(state: _State) -> _State:
    return state._replace(
        moved=jnp.asarray(False), shortened=jnp.asarray(False),
        update=jnp.full_like(state.update, jnp.inf),
        iterations=jnp.zeros_like(state.iterations),
    )  # fmt: skip


# Stiffness of single cells at rest, for bodies whose cells differ by a factor


def stiffness_at_rest(
    problem: Any,
) -> tuple[Float[Array, "blocks entries lanes"], Float[Array, " nnz"]]:
    """Matrices of all cells in the blocks of the space [N/m], and what the loads add to the
    tangent, in the order of its values."""
    prepared = prepare_traced(problem) if is_traced(problem) else prepare(problem)
    rest = jnp.zeros_like(problem.mesh.points)
    cells = cell_matrices(
        problem.space, prepared.geometry, problem.material, problem.kinematics, rest
    )
    one = jnp.ones(problem.space.num_cells)
    whole = linearise(problem, prepared, rest, rest).values
    return cells, whole - assembled(problem.space, cells, one)


@eqx.filter_jit
def assembled(
    space: Space,
    cells: Float[Array, "blocks entries lanes"],
    factor: Float[Array, " cells"],
) -> Float[Array, " nnz"]:
    """Tangent of the body in which each cell counts `factor` times [N/m]."""
    scaled = cells * factor[space.ids][:, None]
    values = jnp.zeros(space.system.num_values + 1, cells.dtype).at[space.slots].add(scaled)
    return jax.lax.slice_in_dim(values, 0, space.system.num_values)
