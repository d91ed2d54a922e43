"""Equilibrium and load paths, differentiable in every number of the problem.

The derivative is that of the implicit function at the converged state: one more
back-substitution per direction, whatever steps the solver took to get there.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax import _check
from sorojax._display import displayed, number, outcome
from sorojax._jax.trace_state import evaluated_now, is_traced
from sorojax._progress import report
from sorojax._types import real
from sorojax.fem.contact.self_contact import SelfContact
from sorojax.fem.crossings import self_crossings
from sorojax.fem.equilibrium.implicit_diff import Solve, equilibrium
from sorojax.fem.equilibrium.jit import Begin
from sorojax.fem.equilibrium.load_stepping import Stats, between, unloaded
from sorojax.fem.equilibrium.newton import Newton
from sorojax.fem.loads.glue import Glue
from sorojax.fem.problem import Problem, body
from sorojax.fem.relaxation import (
    Past,
    at_instant,
    first_past,
    from_past,
    moduli,
    next_past,
    softens,
)
from sorojax.math.status import Status

_MANY_CELLS = 50_000  # beyond, a print does not look for sides that pass through each other


@displayed
class Solution(eqx.Module):
    """`displacement` at equilibrium [m], or at the last converged fraction of the load.

    Every array gets the batch axes of `jax.vmap` in front, so each lane has its own
    `status`, `load_fraction`, Newton `iterations`, accepted `load_steps` and `cuts`. Of
    `cavities` whose contents are given `pressures` are gauge pressures [Pa], as in `problem`,
    and `volumes` in m^3. `stats`
    is kept on the host: the record of the solve, under `vmap` a tuple with that of every lane
    in row-major order, and `None` under `jit`, where it does not exist yet.
    """

    problem: Problem
    displacement: Float[Array, "nodes dim"]
    status: Status
    stats: Any = eqx.field(static=True)  # Stats, one per lane under vmap, None under jit
    load_fraction: Float[Array, ""] | None = None
    iterations: Int[Array, ""] | None = None
    load_steps: Int[Array, ""] | None = None
    cuts: Int[Array, ""] | None = None
    cavities: tuple[str, ...] = eqx.field(static=True, default=())
    pressures: Float[Array, " cavities"] | None = None
    volumes: Float[Array, " cavities"] | None = None

    def _text(self) -> str:
        u = self.displacement
        largest = number(jnp.max(jnp.sqrt(jnp.sum(u**2, axis=-1))), "m")
        rows = [f"Solution: {outcome(self.status)}, largest displacement {largest}"]
        if self.iterations is not None:
            part = number(self.load_fraction)
            rows.append(f"  {number(self.iterations)} iterations, load fraction {part}")
        for k, name in enumerate(self.cavities):
            assert self.pressures is not None and self.volumes is not None
            p, volume = number(self.pressures[..., k], "Pa"), self.volumes[..., k]
            rows.append(f"  {name}: {p} in {number(volume, 'm^3')}")
        return "\n".join(rows + _unstable([self.stats]) + _crossed(self.problem, u))


@displayed
class Path(eqx.Module):
    """Equilibria of a `problem` along a path: `values` of the load or moved support `name`, or
    of the volume of that cavity [m^3], whose gauge `pressures` [Pa] are found; one state for
    each, with its `displacements` [m]. A path over `times` [s] has the `strains` that a
    viscoelastic body remembers at each, that of a body that softens its `peaks` [J/m^3]
    (`fem.relaxation`).

    `status` says how the path ended. One that stops early is cut there; under `jit` and `vmap`
    it keeps its length and is NaN from there on. `stats` has one entry for each value, as in
    `Solution`; it is `None` under `jit`.
    """

    problem: Problem
    displacements: Float[Array, "steps nodes dim"]
    values: Float[Array, "steps ..."]
    name: str | None = eqx.field(static=True)  # none of a continuation under all loads
    status: Status
    stats: Any = eqx.field(static=True)  # one Stats per value, None under jit
    pressures: Float[Array, " steps"] | None = None
    times: Float[Array, " steps"] | None = None
    strains: Float[Array, "steps rows entries quad cells"] | None = None
    peaks: Float[Array, "steps quad cells"] | None = None

    def __len__(self) -> int:
        return self.displacements.shape[0]

    def problem_at(self, k: int) -> Problem:
        """The problem with the loads of state `k`, and what the body remembers there."""
        problem = self.problem_under(self.loading[k])
        strains, peaks = (None if x is None else x[k] for x in (self.strains, self.peaks))
        return at_instant(problem, moduli(problem), strains, peaks)

    @property
    def loading(self) -> Float[Array, "steps ..."]:
        """What `problem_under` takes, of each state."""
        return self.values if self.pressures is None else self.pressures

    def problem_under(self, value: Float[Array, "..."]) -> Problem:
        """The problem with the load of one state."""
        if self.name is None:
            return between(unloaded(self.problem), self.problem, value)
        return with_load(self.problem, self.name, value)

    def _text(self) -> str:
        u = self.displacements
        largest = number(jnp.max(jnp.sqrt(jnp.sum(u**2, axis=-1))), "m") if u.size else "none"
        last = _crossed(self.problem, u[-1]) if u.size else []
        return (
            f"Path: {len(self)} states, {outcome(self.status)}, largest displacement "
            f"{largest}\n  {self.name} {number(self.values)}"
        ) + "".join(f"\n{row}" for row in _unstable(self.stats) + last)


def _crossed(problem: Problem, u: Array) -> list[str]:
    """A line of a print about a body that passes through itself."""
    keeps = any(isinstance(load, SelfContact | Glue) for load in problem.loads)
    many = problem.mesh.points.ndim > 2 or problem.mesh.num_cells > _MANY_CELLS
    if keeps or many or u.ndim > 2 or is_traced((problem, u)):
        return []
    count = len(self_crossings(problem, u))
    if count == 0:
        return []
    return [f"  the body passes through itself, {count} pairs of facets: see fem.SelfContact"]


def _unstable(records: Any) -> list[str]:
    """Lines of a print about states that are in balance without being stable."""
    steps = [r.steps[-1] for r in records or () if isinstance(r, Stats) and r.steps]
    if not any(step.negative_eigenvalues > 0 for step in steps):
        return []
    counts = ", ".join(str(step.negative_eigenvalues) for step in steps)
    return [f"  not stable: negative eigenvalues of the tangent {counts}; see `continuation`"]


class ConvergenceError(RuntimeError):
    """No equilibrium was found; `solution` holds the last converged state."""

    def __init__(self, message: str, solution: Solution):
        super().__init__(message)
        self.solution = solution

    def __reduce__(self):
        return type(self), (str(self), self.solution)


def solve(
    problem: Problem,
    *,
    start: Float[Array, "nodes dim"] | None = None,
    newton: Newton | None = None,
    steps: int = 1,
    max_cuts: int = 10,
    throw: bool = True,
) -> Solution:
    """Static equilibrium of `problem` by Newton's method on the residual of virtual work.

    All loads and prescribed displacements grow together from zero, first in `steps` equal
    steps; a step that fails is halved, and steps grow again where iterations are few. The
    answer does not depend on the steps unless the equilibrium is not unique. Its derivative is
    that of the implicit function: K du = -dR/dp dp with the tangent K at the solution.

    Works under `jit`, `vmap`, `grad` and their compositions. `vmap` outside `jit` is the
    fast way through many samples: each may start from its nearest solved neighbour. A sample
    that fails does not disturb the others and has NaN for derivatives.

    Args:
        problem: What to solve; differentiable in each of its numbers.
        start: Displacement [m] to start from at full load; where it is too far away the loads
            are stepped from rest. The answer has no derivative with respect to it. By
            default the loads grow from zero.
        newton: Tolerances; `Newton()` by default.
        steps: Number of equal load steps to try first.
        max_cuts: How often a step may be halved in a row.
        throw: Raise when no equilibrium is found, otherwise report it in `status`. Under
            `jit` and `vmap` nothing is raised: check `status`.

    Returns:
        The displacement [m], how the search ended, and a record of its steps.

    Raises:
        ConvergenceError: If `throw` and a step failed after all cuts.

    Example:
        >>> bar = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1),
        ...                      element=mesh.Quad9())
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1000)
        >>> problem = fem.problem(
        ...     bar, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...     supports=(fem.Fixed(bar.node_sets["left"]),),
        ...     loads=(fem.Force(bar.node_sets["right"], [0, -0.02], name="push"),))
        >>> solution = fem.solve(problem)
        >>> print(f"{float(solution.displacement[:, 1].min()) / mm:.2f} mm")
        -0.44 mm

    Reference:
        Wriggers, Nonlinear Finite Element Methods, 2008, chapter 5.
    """
    settings = (Newton() if newton is None else newton, steps, max_cuts)
    return solved_and_kept(problem, start, settings, throw)[0]


def solved_and_kept(
    problem: Problem, start: Any, settings: tuple[Newton, int, int], throw: bool
) -> tuple[Solution, Float[np.ndarray, "nodes dim"] | None]:
    """`solve`, and the displacement on the host where that is known, which needs no operation
    that a derivative would stage."""
    call = Solve(problem, None if start is None else _begun(start), *settings)
    u, counts, _ = equilibrium(call)
    solution = Solution(problem, u, *_counted(counts, call.stats))
    _raise_if_failed("fem.solve", solution, throw)
    return solution, call.record.displacement


def _begun(start: Any) -> Begin:
    if is_traced(start):
        return Begin(jax.lax.stop_gradient(real(start)))
    with evaluated_now():
        return Begin(real(start))


def _counted(counts: Float[Array, " 5"], stats):
    """Status, record, fraction of the load, iterations, load steps and cuts, from what is
    concrete at once: every operation beside a derivative is staged with it."""
    with evaluated_now(counts):
        if isinstance(stats, Stats):
            failed, fraction, *whole = np.asarray(counts)
            status = Status.not_converged if failed else Status.successful
            iterations, cuts, steps = map(jnp.asarray, np.asarray(whole, np.int32))
            return status, stats, jnp.asarray(fraction), iterations, steps, cuts
        whole = counts.astype(jnp.int32)
        return _status(counts[0] != 0), stats, counts[1], whole[2], whole[4], whole[3]


def solve_path(
    problem: Problem,
    *,
    times: Float[Array, " steps"] | None = None,
    newton: Newton | None = None,
    max_cuts: int = 10,
    throw: bool = True,
    **values: Float[Array, "steps ..."],
) -> Path:
    """Equilibria for a sequence of values of one named load or moved support, the others held.

    With `times` a body of `material.Viscoelastic` relaxes and creeps on the way, without
    inertia: the first state is that of the first value held for long, steps are of order 2.
    A body of `material.Softening` remembers the largest energy of the states before.

    Newton's method from state to state with the tangent as predictor; a step that fails is
    halved. Every state is differentiable as that of `solve`.

    Args:
        problem: The problem; differentiable in each of its numbers.
        times: Increasing times of the states [s]; without them the body has all the time
            there is.
        newton: Tolerances; `Newton()` by default.
        max_cuts: How often a step between two values may be halved in a row.
        throw: Raise when a value has no equilibrium, otherwise stop the path there. Under
            `jit` and `vmap` nothing is raised: check `status`.
        **values: One load by name, with one value per state in the unit of the load, as in
            `solve_path(problem, air=jnp.linspace(0, 20 * kPa, 21))`; or one `Prescribed` or
            `Rotated` support, with its displacements [m] or angles [rad].

    Returns:
        Displacements [m], values, and how each search ended.

    Raises:
        ConvergenceError: If `throw` and a step failed after all cuts.
        ValueError: If not exactly one existing load or moved support is named, or its values
            have the wrong shape or are not finite.

    Example:
        >>> bar = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1),
        ...                      element=mesh.Quad9())
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1000)
        >>> problem = fem.problem(
        ...     bar, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...     supports=(fem.Fixed(bar.node_sets["left"]),),
        ...     loads=(fem.Force(bar.node_sets["right"], [0, -0.02], name="push"),))
        >>> path = fem.solve_path(problem, push=jnp.array([[0, -0.01], [0, -0.02]]))
        >>> [round(float(u[:, 1].min()) / mm, 2) for u in path.displacements]
        [-0.22, -0.44]
    """
    name, row = _named_values(problem, values)
    newton = Newton() if newton is None else newton
    times = None if times is None else real(times)
    steps, past = _aging(problem, row, times)

    # inside jit even a constant is traced: one compiled loop over the values then
    if is_traced(jnp.zeros(())):
        states, kept, failed = _scan_path(problem, name, row, steps, past, newton, max_cuts)
        found = problem, states, row, name, _status(failed), None, None
        return Path(*found, times, *kept)
    begin, states, stats, failed, kept = None, [], [], jnp.asarray(False), []
    for k, value in enumerate(row):
        target = with_load(problem, name, value)
        if past is not None:
            since = None if steps is None else steps[k]
            target = from_past(target, past, since)
        call = Solve(target, begin, newton, 1, max_cuts, want_tangent=True)
        u, counts, tangent = equilibrium(call)
        record = call.stats
        stats.append(record)
        if not isinstance(record, Stats):
            failed = failed | (counts[0] != 0)
            u = at = jnp.where(failed, jnp.nan, u)
        elif record.reason:
            failed = jnp.asarray(True)
            solution = Solution(target, u, Status.not_converged, record)
            _raise_if_failed("fem.solve_path", solution, throw)
            break
        else:  # nothing to hide, and no operation that a derivative would stage
            at = _begun(call.record.displacement).u
        states.append(u)
        if past is not None:
            past = next_past(body(problem), past, since, u)
            kept.append((past.strains, past.peaks))
        begin = _fixed(Begin(at, (target.loads, target.supports), tangent))
        lanes = (record,) if isinstance(record, Stats) else record or ()
        report(
            "equilibrium", k + 1, len(row), iterations=sum(lane.iterations for lane in lanes)
        )
    shape = (0, *problem.mesh.points.shape)
    stacked = jnp.stack(states) if states else jnp.zeros(shape)
    found = problem, stacked, row[: len(states)], name, _status(failed), tuple(stats), None
    times = None if times is None else times[: len(states)]
    rows = zip(*kept, strict=True) if kept else [(None,)] * 2
    return Path(*found, times, *(None if r[0] is None else jnp.stack(r) for r in rows))


_FOREVER = 1e30  # time in which everything relaxes [s]; infinity would have no derivative


def _aging(
    problem: Problem, row: Array, times: Float[Array, " steps"] | None
) -> tuple[Any, Past | None]:
    """Time since the state before [s] where it plays a part, and the past of a body that
    remembers and begins relaxed."""
    if times is None:
        if not softens(problem):
            return None, None
        return None, first_past(body(problem), jnp.zeros_like(problem.mesh.points), False)
    do = "Give one increasing time [s] for each value."
    _check.shape("fem.solve_path", "times", times, (row.shape[0],), do)
    steps = jnp.diff(times)
    _check.positive("fem.solve_path", "steps of times", steps, "s", do)
    past = first_past(body(problem), jnp.zeros_like(problem.mesh.points), True)
    if past.strains is None:
        return None, past if softens(problem) else None
    return jnp.concatenate([jnp.full(1, _FOREVER, steps.dtype), steps]), past


def _scan_path(
    problem: Problem, name: str, row, steps, past: Past | None, newton: Newton, max_cuts: int
) -> tuple[Float[Array, "steps nodes dim"], Any, Bool[Array, ""]]:
    """The same in a trace; NaN from the first failure on."""
    rest = unloaded(problem)
    u = jnp.zeros_like(problem.mesh.points)
    # no finite tangent, no first guess
    tangent = jnp.full(problem.space.system.num_values, jnp.nan, u.dtype)
    terms, static = eqx.partition((rest.loads, rest.supports), eqx.is_inexact_array)

    def advance(carry, now):
        (value, step), (before, past) = now, carry
        u, terms, tangent = jax.lax.stop_gradient(before)
        target = with_load(problem, name, value)
        if past is not None:
            target = from_past(target, past, step)
        begin = Begin(u, eqx.combine(terms, static), tangent)
        call = Solve(target, begin, newton, 1, max_cuts, want_tangent=True)
        u, counts, tangent = equilibrium(call)
        failed = counts[0] != 0
        u = jnp.where(failed, jnp.nan, u)
        terms = eqx.filter((target.loads, target.supports), eqx.is_inexact_array)
        if past is not None:
            past = next_past(body(problem), past, step, u)
        kept = (None, None) if past is None else (past.strains, past.peaks)
        return ((u, terms, tangent), past), (u, kept, failed)

    start = (u, terms, tangent), past
    _, (states, kept, failed) = jax.lax.scan(advance, start, (row, steps))
    return states, kept, jnp.any(failed)


def _fixed(begin: Begin) -> Begin:
    """`begin` without derivatives: an equilibrium does not depend on where it came from."""

    def fixed(x):
        moves = is_traced(x) and jnp.issubdtype(x.dtype, jnp.inexact)
        return jax.lax.stop_gradient(x) if moves else x

    return jax.tree.map(fixed, begin)


def _status(failed: Bool[Array, "..."]) -> Status:
    return Status.where(failed, Status.not_converged, Status.successful)


def _named_values(problem: Problem, values: dict) -> tuple[str, Float[Array, "steps ..."]]:
    names = _names(problem)
    if len(values) != 1 or next(iter(values)) not in names:
        raise ValueError(
            f"fem.solve_path: got values for {sorted(values)}, need exactly one of the loads "
            f"and moved supports {names}. Name one with `name=`."
        )
    name, row = next(iter(values.items()))
    row = real(row)
    _check.finite("fem.solve_path", name, row, "Use SI units: jnp.linspace(0, 20 * kPa, 21).")
    want = value_of(problem, name)(problem).shape
    if row.shape[1:] != want or not row.shape:
        raise ValueError(
            f"fem.solve_path: `{name}` has shape {row.shape}, need (steps, *{want})."
        )
    return name, row


def _names(problem: Problem) -> list[str]:
    """Names of the loads, then of the supports that move."""
    moved = [support.name for support in problem.supports if support.ramped is not None]
    return [load.name for load in problem.loads] + moved


def value_of(
    problem: Problem, name: str, where: str = "fem.with_load"
) -> Callable[[Problem], Float[Array, "..."]]:
    """Where a problem has the value of the load or moved support of that name."""
    names = _names(problem)
    if name not in names:
        raise ValueError(
            f"{where}: no load or moved support is called {name!r}, need one of {names}. "
            "Set `name=` where it is made."
        )
    if names.count(name) > 1:
        raise ValueError(
            f"{where}: {names.count(name)} loads or moved supports are called {name!r}, "
            "need one. Give each its own `name=`."
        )
    index = names.index(name) - len(problem.loads)
    if index < 0:
        return lambda p: p.loads[index].value
    moved = [k for k, s in enumerate(problem.supports) if s.ramped is not None]
    place, field = moved[index], problem.supports[moved[index]].ramped
    assert field is not None
    return lambda p: getattr(p.supports[place], field)


def with_load(problem: Problem, name: str, value: Float[Array, "..."]) -> Problem:
    """`problem` with the load called `name` set to `value`, or the support of that name moved
    by it: displacements [m] of a `Prescribed`, the angle [rad] of a `Rotated`.

    Args:
        problem: The boundary value problem.
        name: Of the load or support.
        value: In the unit of the load.

    Returns:
        The problem with that value.
    """
    where = value_of(problem, name)
    # a weakly typed number would compile every kernel again
    made = eqx.tree_at(where, problem, real(value))
    if name in (names := [load.name for load in problem.loads]):
        index = names.index(name)
        _check.same_space("fem.with_load", problem.loads[index], made.loads[index])
    return made


def _raise_if_failed(where: str, solution: Solution, throw: bool) -> None:
    stats = solution.stats
    if not throw or not isinstance(stats, Stats) or not stats.reason:
        return
    done = stats.steps[-1].fraction if stats.steps else 0.0
    raise ConvergenceError(
        f"{where}: no equilibrium beyond {100 * done:.0f} % of the load after {stats.cuts} "
        f"cuts ({stats.reason}). Lower the load, or refine the mesh where it deforms most. "
        "Where the body gives way, as a balloon past its highest pressure, give the volume of "
        "the cavity (fem.solve_volume), or follow the branch by arc length "
        "(fem.continuation). throw=False returns the last converged state.",
        solution,
    )
