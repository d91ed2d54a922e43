"""Equilibrium of bodies with closed cavities, differentiable by the implicit function theorem.

The pressure of a cavity is an unknown that its contents determine: a given volume of liquid,
or a gas. The tangent is bordered by one row per cavity.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.jit import once
from sorojax._jax.trace_state import evaluated_now, is_traced
from sorojax._progress import report
from sorojax._types import from_host, real
from sorojax.fem.checks import no_peaks
from sorojax.fem.equilibrium import rules
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.fem.equilibrium.load_stepping import LoadStep, Log, between, unloaded
from sorojax.fem.equilibrium.newton import Newton
from sorojax.fem.equilibrium.solve import ConvergenceError, Path, Solution
from sorojax.fem.problem import Problem, load_potential, residual
from sorojax.fem.stability.arc_length import Border, newton_bordered
from sorojax.fem.supports import known_values
from sorojax.math.linalg import sparse


class AbstractContents(eqx.Module):
    """The contents of a cavity: the volume that they take at a pressure."""

    @abc.abstractmethod
    def volume_at(self, pressure: Float[Array, ""]) -> Float[Array, ""]:
        """Volume [m^3] at a gauge pressure [Pa]."""


class Liquid(AbstractContents):
    """A liquid that takes `volume` [m^3] at no gauge pressure; without `bulk_modulus` [Pa]
    it is incompressible: the cavity is controlled by its volume."""

    volume: Float[Array, ""] = eqx.field(converter=real)
    bulk_modulus: Float[Array, ""] = eqx.field(converter=real, default=np.inf)

    def __check_init__(self):
        _check.positive("Liquid", "volume", self.volume, "m^3", "Write 20e-6, for example.")

    def volume_at(self, pressure):
        return self.volume * jnp.exp(-pressure / self.bulk_modulus)


class Gas(AbstractContents):
    """A sealed amount of gas: (pressure + ambient) volume^exponent is constant.

    It takes `volume` [m^3] at the gauge `pressure` [Pa]; `exponent` is 1 for slow and 1.4
    for fast changes of air. Where symmetry cuts the cavity `volume` is that of the part.
    `ambient` is the absolute pressure outside [Pa].
    """

    volume: Float[Array, ""] = eqx.field(converter=real)
    pressure: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    exponent: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    ambient: Float[Array, ""] = eqx.field(converter=real, default=101325.0)

    def __check_init__(self):
        _check.positive("Gas", "volume", self.volume, "m^3", "Write 20e-6, for example.")
        _check.positive("Gas", "exponent", self.exponent, "", "1 is isothermal, 1.4 adiabatic.")
        _check.positive(
            "Gas",
            "pressure + ambient",
            self.pressure + self.ambient,
            "Pa",
            "A gas cannot pull.",
        )

    def volume_at(self, pressure):
        ratio = (self.pressure + self.ambient) / (pressure + self.ambient)
        return self.volume * ratio ** (1 / self.exponent)


Names = tuple[str, ...]


class CavityStart(eqx.Module):
    """A state to start from, and the loads it is in equilibrium with."""

    problem: Problem
    u: Float[Array, "nodes dim"]
    pressures: Float[Array, " cavities"]


def with_pressures(
    problem: Problem, names: Names, pressures: Float[Array, " cavities"]
) -> Problem:
    """`problem` with the loads called `names` set."""
    order = [load.name for load in problem.loads]
    indices = [order.index(name) for name in names]
    return eqx.tree_at(lambda p: [p.loads[i].value for i in indices], problem, list(pressures))


@once
def volumes(
    problem: Problem, names: Names, u: Float[Array, "nodes dim"]
) -> Float[Array, " cavities"]:
    """Volumes [m^3] that the pressures called `names` work on."""

    def potential(pressures):
        return load_potential(with_pressures(problem, names, pressures), u)

    return -jax.grad(potential)(jnp.zeros(len(names), u.dtype))


def _wanted(contents: tuple[AbstractContents, ...], pressures):
    return jnp.stack([c.volume_at(p) for c, p in zip(contents, pressures, strict=True)])


@once
def _slopes(problem: Problem, names: Names, u) -> Float[Array, "cavities dofs"]:
    """Slopes of the volumes [m^2], nodal forces of a unit pressure in each cavity."""
    return jax.jacrev(lambda u: volumes(problem, names, u))(u).reshape(len(names), -1)


@once
def _border(problem: Problem, names: Names, contents, begin, share, u, pressures) -> Border:
    """The border on the way from the volumes `begin` to those of the contents."""

    def wanted(pressures):
        return begin + share * (_wanted(contents, pressures) - begin)

    inside = volumes(problem, names, u)
    slope = _slopes(problem, names, u)
    known = known_values(problem.supports, *u.shape)
    # The potential is minus pressure times volume: B = C makes the border symmetric.
    return Border(
        force_rate=-slope,
        known=known,
        known_rate=jnp.zeros_like(slope),
        gap=wanted(pressures) - inside,
        gap_slope=-slope,
        gap_rate=jax.jacfwd(wanted)(pressures),
        scale=jnp.abs(inside),
    )


def follow_contents(
    problem: Problem,
    names: Names,
    contents: tuple[AbstractContents, ...],
    begin: CavityStart,
    log: Log,
) -> tuple[np.ndarray, np.ndarray]:
    """Displacement and pressures at equilibrium with the contents, in adaptive steps."""
    prepared = prepare(problem)
    u, pressures = np.asarray(begin.u), np.asarray(begin.pressures)
    first = volumes(problem, names, jnp.asarray(u))
    way = rules.first_step(log.num_steps)
    while way.done < 1.0:
        goal = rules.goal(way)

        def at(u, y, goal=goal):
            here = with_pressures(between(begin.problem, problem, goal), names, jnp.asarray(y))
            share, u = jnp.asarray(goal), jnp.asarray(u)
            return here, _border(here, names, contents, first, share, u, jnp.asarray(y))

        found = newton_bordered(at, prepared, u, pressures, log.newton)
        if found.reason:
            way = rules.cut(way)
            log.cuts = way.cuts
            if not rules.goes_on(way, log.num_steps, log.max_cuts):
                log.reason = found.reason
                return u, pressures
            continue
        u, pressures, way = found.u, found.y, rules.accept(way, found.iterations)
        log.steps.append(LoadStep(goal, found.iterations, found.residual, -1))
        report("contents", goal, 1.0, iterations=found.iterations, cuts=log.cuts)
    return u, pressures


# Equilibrium with closed cavities, differentiable by the implicit function theorem


def solve_volume(
    problem: Problem,
    *,
    start: Solution | None = None,
    newton: Newton | None = None,
    steps: int = 1,
    max_cuts: int = 10,
    throw: bool = True,
    **contents: AbstractContents | float,
) -> Solution:
    """Static equilibrium of a body whose cavities hold a given volume or a sealed gas.

    The pressure of each cavity is an unknown beside the displacements; one equation per cavity
    says that its volume is that of its contents (a bordered Newton system). States past
    the largest pressure are reached like any other. The values that these loads have in
    `problem` do not matter; other loads and supports act as they are.

    Args:
        problem: Differentiable in each of its numbers, as are the contents.
        start: A solution of the same mesh to start from; at rest by default. The answer has no
            derivative with respect to it.
        newton: Tolerances; `Newton()` by default.
        steps: Number of equal steps of the volume to try first.
        max_cuts: How often a step may be halved in a row.
        throw: Raise when no equilibrium is found, otherwise report it in `status`.
        **contents: By name of a `Pressure`: a volume [m^3] that is prescribed, `Liquid(...)`,
            or `Gas(15e-6)` for 15 cm^3 of air sealed at ambient pressure.

    Returns:
        Displacement [m], gauge pressures [Pa] and volumes [m^3] of the cavities, and how the
        search ended.

    Raises:
        ConvergenceError: If `throw` and a step failed after all cuts.
        ValueError: If a name is no pressure of the problem, or under `jit` or `vmap`.

    Example:
        >>> grid = mesh.rectangle([0, 0], [60 * mm, 12 * mm], divisions=(6, 4),
        ...                       element=mesh.Quad4())
        >>> tube = mesh.submesh(grid, np.delete(np.arange(24), [6, 10, 14, 18]))  # a chamber
        >>> wall = mesh.facets_on(tube, sdf.Rectangle([10 * mm, 6 * mm], [50 * mm, 9 * mm]))
        >>> problem = fem.problem(
        ...     tube, material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1000),
        ...     kinematics=fem.PlaneStrain(20 * mm), loads=(fem.Pressure(wall, name="air"),),
        ...     supports=(fem.Fixed(tube.node_sets["left"]),))
        >>> filled = fem.solve_volume(problem, air=2.8e-6)  # 2.4 cm^3 at rest
        >>> print(f"{float(filled.pressures[0]) / kPa:.2f} kPa")
        0.61 kPa

    Reference:
        Crisfield, A fast incremental/iterative solution procedure that handles "snap-through",
        Computers & Structures 13, 1981, for the bordered system.
    """
    names, filled = _checked(problem, contents)
    log = Log(Newton() if newton is None else newton, steps, max_cuts)
    begin = _begin(problem, names, start)
    u, pressures = _equilibrium(problem, names, filled, begin, log)
    found = with_pressures(problem, names, pressures)
    filled_to = volumes(found, names, u)
    solution = Solution(
        found,
        u,
        log.status,
        log.stats(),
        cavities=names,
        pressures=pressures,
        volumes=filled_to,
    )
    if throw and log.reason:
        done = log.steps[-1].fraction if log.steps else 0.0
        raise ConvergenceError(
            f"fem.solve_volume: no equilibrium beyond {100 * done:.0f} % of the change of "
            f"volume after {log.cuts} cuts ({log.reason}). Give less volume, refine the mesh, "
            "or pass throw=False for the last converged state.",
            solution,
        )
    return solution


def volume_path(
    problem: Problem,
    *,
    newton: Newton | None = None,
    max_cuts: int = 10,
    **row: Float[Array, " steps"],
) -> Path:
    """Equilibria for a row of volumes [m^3] of one cavity: the curve of a balloon, over its
    largest pressure. The path stops where a volume has no equilibrium; see `status`.

    Args:
        problem: The boundary value problem.
        newton: Tolerances; `Newton()` by default.
        max_cuts: How often a step between two volumes may be halved in a row.
        **row: Volumes [m^3], by the name of the `Pressure` load of the cavity.

    Returns:
        Displacements [m], pressures [Pa] and how each search ended.

    Raises:
        ValueError: If not exactly one pressure of the problem is named, or the body softens.
    """
    if len(row) != 1:
        raise ValueError(
            f"fem.volume_path: got volumes for {sorted(row)}, need those of one pressure. Name "
            "it, as in air=jnp.linspace(1e-5, 2e-5, 11)."
        )
    no_peaks("fem.volume_path", problem.material)
    ((name, wanted),) = row.items()
    wanted, found = real(wanted), []
    _check.shape("fem.volume_path", name, wanted, (None,), "Give one volume per state.")
    for k, volume in enumerate(wanted):
        begin = found[-1] if found else None
        solution = solve_volume(
            problem,
            start=begin,
            newton=newton,
            max_cuts=max_cuts,
            throw=False,
            **{name: Liquid(volume)},  # type: ignore[arg-type]
        )
        status, stats = solution.status, solution.stats
        if stats.reason:
            break
        found.append(solution)
        report("volume", k + 1, len(wanted), iterations=stats.iterations)
    shape = problem.mesh.points.shape
    states = jnp.stack([s.displacement for s in found]) if found else jnp.zeros((0, *shape))
    rows = [s.pressures for s in found if s.pressures is not None]
    pressures = jnp.concatenate(rows) if rows else jnp.zeros(0)
    record = tuple(s.stats for s in found) + ((stats,) if stats.reason else ())
    return Path(problem, states, wanted[: len(found)], name, status, record, pressures)


def _checked(problem: Problem, contents: dict) -> tuple[Names, tuple[AbstractContents, ...]]:
    loads = {load.name: load for load in problem.loads}
    scalar = [name for name, load in loads.items() if jnp.ndim(load.value) == 0]
    if not contents or not set(contents) <= set(scalar):
        raise ValueError(
            f"fem.solve_volume: got contents for {sorted(contents)}, need some of the "
            f"pressures {scalar}. Name a `Pressure` with `name=`."
        )
    filled = tuple(
        c if isinstance(c, AbstractContents) else Liquid(c) for c in contents.values()
    )
    return tuple(contents), filled


def _begin(problem: Problem, names: Names, start: Solution | None) -> CavityStart:
    if start is not None:
        order = [load.name for load in start.problem.loads]
        values = [start.problem.loads[order.index(name)].value for name in names]
        return CavityStart(start.problem, start.displacement, jnp.stack(values))
    zero = jnp.zeros_like(problem.mesh.points)
    return CavityStart(unloaded(problem), zero, jnp.zeros(len(names), zero.dtype))


def _equilibrium(problem, names: Names, contents, begin: CavityStart, log: Log):
    """Displacement and pressures with the derivative of the implicit function."""
    params, rest = eqx.partition((problem, contents), eqx.is_inexact_array)
    held, pattern = eqx.partition(begin, eqx.is_array)
    held = jax.lax.stop_gradient(held)

    @jax.custom_jvp
    def equilibrium(params):
        if is_traced((params, held)):
            raise ValueError(
                "fem.solve_volume: called under jit or vmap, need concrete numbers. Call it "
                "outside: its kernels are compiled already, and grad works without jit."
            )
        problem, contents = eqx.combine(params, rest)
        with evaluated_now():
            start = eqx.combine(held, pattern)
            found = follow_contents(problem, names, contents, start, log)
            return from_host(found[0]), from_host(found[1])

    @equilibrium.defjvp
    def derivative(primals, tangents):
        state = equilibrium(*primals)
        return state, _tangent(rest, names, state, primals[0], tangents[0])

    return equilibrium(params)


def _tangent(rest, names: Names, state, params, params_dot):
    """(du, dp) of R(u, p, params) = 0 and of the balance of volumes."""
    u, pressures = state
    problem = with_pressures(eqx.combine(params, rest)[0], names, pressures)

    def known(params):
        return known_values(eqx.combine(params, rest)[0].supports, *u.shape)

    def unbalanced(params, u, pressures):
        problem, contents = eqx.combine(params, rest)
        here = with_pressures(problem, names, pressures)
        gap = _wanted(contents, pressures) - volumes(here, names, u)
        return residual(here, u).ravel(), gap

    _, move = jax.jvp(known, (params,), (params_dot,))
    still = jnp.zeros_like(pressures)
    _, (force, gap) = jax.jvp(
        unbalanced, (params, u, pressures), (params_dot, move.reshape(u.shape), still)
    )
    contents_rate = jax.jacfwd(lambda p: unbalanced(params, u, p)[1])(pressures)
    slope = _slopes(problem, names, u)
    with evaluated_now(params, u):
        prepared = prepare(problem)
        values = linearise(problem, prepared, u, u).values
        matrix = sparse.fix(problem.space.system, values, prepared.known)
    system, fixed = problem.space.system, prepared.known
    # Apart, because only the first is linear in the direction.
    direct = sparse.solve(system, matrix, jnp.where(fixed, jnp.zeros_like(force), -force))
    rows = jnp.where(fixed[None], jnp.zeros_like(slope), slope)
    rates = jax.vmap(lambda b: sparse.solve(system, matrix, b))(rows)
    change = jnp.linalg.solve(contents_rate - slope @ rates.T, -(gap - slope @ direct))
    return (direct + change @ rates + move).reshape(u.shape), change
