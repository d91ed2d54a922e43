"""Objectives of a design: numbers of an equilibrium, differentiable in the design.

`graded` puts a design into a problem; `Follower` solves it, from the displacement of the last
design where that is near enough. Designs under large loads reach their buckling load while
they are optimised; beyond it the load path ends at a limit point and the body snaps.
`relax_to_minimum` finds the stable state that it then falls into: its energy is minimised by
Newton's method with a shift that keeps the tangent positive definite.

Reference: Nocedal, Wright, "Numerical Optimization", 2nd ed., 2006, sections 3.2 and 3.4.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._edit import without_derivatives
from sorojax._jax.host_call import tell_host
from sorojax._jax.trace_state import is_traced
from sorojax.design.density.void import InterpolatedEnergy, interpolated_energy
from sorojax.fem import Newton, Problem, Solution
from sorojax.fem.equilibrium.linear import Prepared, constrain, linearise, prepare
from sorojax.fem.equilibrium.newton import safe_fraction
from sorojax.fem.equilibrium.rules import SAFE
from sorojax.fem.equilibrium.solve import Path, solved_and_kept
from sorojax.fem.loads.loads import AbstractLoad, mean_rotation
from sorojax.fem.problem import exchanged, load_potential, potential_energy
from sorojax.material.hyperelastic import AbstractHyperelastic
from sorojax.math.linalg.sparse import SparseSymmetric

_FIRST, _GROWTH, _SHRINK = 1e-3, 4.0, 0.25  # of the shift, relative to the diagonal at rest
_DESCENT = 1e-4  # share of the decrease by the slope that a step has to bring
_HALVINGS = 12


def relax_to_minimum(
    problem: Problem, u: Float[Any, "nodes dim"], *, steps: int = 100, tolerance: float = 1e-6
) -> tuple[Float[np.ndarray, "nodes dim"], bool]:
    """A state of least energy downhill of the displacement `u` [m], and whether it was
    reached and is stable.

    All loads act in full. For concrete numbers; the answer is a start for `fem.solve`.

    Args:
        problem: Whose supports hold at `u`.
        u: Where to begin.
        steps: Most factorisations.
        tolerance: Largest unbalanced force over the largest load or reaction.

    Returns:
        The displacement [m], and whether it is a stable equilibrium.
    """
    prepared, u = prepare(problem), np.asarray(u)
    size = _diagonal(problem.space.system, _linearised(problem, prepared, 0 * u).values)
    shift, state = 0.0, _linearised(problem, prepared, u)
    energy = float(potential_energy(problem, jnp.asarray(u)))
    for _ in range(steps):
        done = float(state.residual_norm) <= tolerance * float(state.reference)
        values = state.values + (0.0 if done else shift) * size
        matrix, rhs = constrain(problem.space.system, values, state.residual, prepared.known)
        factor = problem.space.system.solver.factor(np.asarray(matrix))
        if done:
            return u, factor is not None and not factor.negative_eigenvalues
        if factor is None or factor.negative_eigenvalues:
            shift = max(_GROWTH * shift, _FIRST)
            continue
        du = factor.solve(np.asarray(rhs)).reshape(u.shape)
        slope = -float(np.vdot(np.asarray(rhs), du))
        share = float(safe_fraction(problem, prepared, u, du))
        share = share if share < SAFE else 1.0  # as it is where no cell comes near to inverting
        for _ in range(_HALVINGS):
            new = float(potential_energy(problem, jnp.asarray(u + share * du)))
            if new <= energy + _DESCENT * share * slope + 1e-12 * abs(energy):
                break
            share /= 2
        else:
            shift = max(_GROWTH * shift, _FIRST)
            continue
        u, energy = u + share * du, new
        shift = shift * _SHRINK if share > 0.5 else shift
        shift = shift if shift > 1e-2 * _FIRST else 0.0
        state = _linearised(problem, prepared, u)
    return u, False


def _linearised(problem: Problem, prepared: Prepared, u: np.ndarray):
    at = jnp.asarray(u)
    return linearise(problem, prepared, at, at)


@jax.jit
def _diagonal(system: SparseSymmetric, values: Float[Array, " nnz"]) -> Float[Array, " nnz"]:
    return jnp.where(system.rows == system.cols, jnp.abs(values), jnp.zeros_like(values))


# What a design is judged by: numbers of an equilibrium, differentiable in the design


def graded(problem: Problem, factor: Float[Array, " cells"], **settings: float) -> Problem:
    """`problem` with `factor` times the stiffness in each cell, linear where that is next to
    nothing; `settings` are those of `interpolated_energy`.

    Every compiled function between a design and its equilibrium adds to the gradient: for a
    small body compile all from the variables to `interpolated_energy` in one by `jax.jit`,
    and put that in its place.

    Args:
        problem: The problem.
        factor: Of the stiffness of each cell [-].
        **settings: `threshold` and `sharpness` of `interpolated_energy`.

    Returns:
        The problem of the design.
    """
    material = interpolated_energy(solid_of(problem), factor, **settings)
    return exchanged(problem, material=material)


def solid_of(problem: Problem) -> AbstractHyperelastic:
    base = problem.material
    return base.base if isinstance(base, InterpolatedEnergy) else base


def replaced_load(problem: Problem, load: AbstractLoad) -> Problem:
    """`problem` with the load of the same name exchanged for `load`.

    Args:
        problem: The problem.
        load: Of the name of the one that it replaces.

    Returns:
        The problem with it.
    """
    names = [old.name for old in problem.loads]
    if load.name not in names:
        raise ValueError(
            f"replaced_load: no load is called {load.name!r}, the problem has {names}. Give "
            "the problem a load of that name first."
        )
    loads = tuple(load if old.name == load.name else old for old in problem.loads)
    return exchanged(problem, loads=loads)


def work_of_loads(
    problem: Problem, u: Float[Array, "nodes dim"], names: tuple[str, ...] | None = None
) -> Float[Array, ""]:
    """f'u of dead loads and p dV of pressures at the displacement `u` [J], of the loads in
    `names` or of all that hold nothing: the compliance of a body at full load.

    Args:
        problem: The problem.
        u: Displacement of the nodes [m].
        names: Of the loads that count.

    Returns:
        Work [J].
    """
    return _work(_loaded(problem, names), u)


def _loaded(problem: Problem, names: tuple[str, ...] | None) -> Problem:
    """The fields that a work depends on: no stiffness, whose derivative would be zero at full
    cost."""
    chosen = [
        load
        for load in problem.loads
        if (not load.holds if names is None else load.name in names)
    ]
    return exchanged(problem, supports=(), loads=tuple(chosen), material=solid_of(problem))


@jax.jit
def _work(problem: Problem, u):
    return load_potential(problem, jnp.zeros_like(u)) - load_potential(problem, u)


def displacement_along(
    u: Float[Array, "nodes dim"], nodes: Int[Any, " n"], direction: Float[Any, " dim"]
) -> Float[Array, ""]:
    """L'x: mean displacement of `nodes` along `direction` [m].

    Args:
        u: Displacement of the nodes [m].
        nodes: Node numbers.
        direction: Unit vector, or any weights.

    Returns:
        The mean [m].
    """
    return _mean_along(u, jnp.asarray(nodes), jnp.asarray(direction, u.dtype))


@jax.jit
def _mean_along(u, nodes, direction):
    return jnp.mean(u[nodes] @ direction)


def mechanism(
    problem: Problem,
    u: Float[Array, "nodes dim"],
    output: Float[Array, ""],
    *,
    output_weight: float = 1.0,
    work_weight: float = 0.0,
) -> Float[Array, ""]:
    """-b1 L'x + b2 f_e'u, what is least in a compliant mechanism.

    `output` is L'x, of `displacement_along` or `rotation`. With b1 = 0 it is the compliance;
    f_u of the reference is read as the displacement where the loads f_e act.

    Args:
        problem: The problem.
        u: Displacement of the nodes [m].
        output: Displacement [m] or rotation [rad] that is wanted.
        output_weight: b1.
        work_weight: b2.

    Returns:
        The number to be minimised.

    Reference: Caasenbrood, Pogromsky, Nijmeijer, "Sorotoki: a Matlab toolkit for design,
    modeling, and control of soft robots", IEEE Access 12, 2024, equation 11.
    """
    return _weighed(_loaded(problem, None), u, output, output_weight, work_weight)


@jax.jit
def _weighed(problem: Problem, u, output, output_weight, work_weight):
    return work_weight * _work(problem, u) - output_weight * output


def rotation(
    problem: Problem, u: Float[Array, "nodes dim"], nodes: Int[Any, " n"]
) -> Float[Array, ""]:
    """Mean angle by which `nodes` of a plane body turn, counter-clockwise [rad].

    Args:
        problem: The problem.
        u: Displacement of the nodes [m].
        nodes: Node numbers.

    Returns:
        The angle [rad].
    """
    return _turn(problem.mesh.points, u, jnp.asarray(nodes))


@jax.jit
def _turn(points, u, nodes):
    return mean_rotation(points[nodes], points[nodes] + u[nodes])


def path_error(
    path: Path, nodes: Int[Any, " n"], targets: Float[Array, "steps dim"]
) -> Float[Array, ""]:
    """Mean square distance of the middle of `nodes` from `targets` over a load path [m^2].

    `path` is that of `fem.solve_path`; `targets` are positions, one for each of its values.

    Args:
        path: From `fem.solve_path`.
        nodes: Node numbers.
        targets: Positions [m], one for each value of the path.

    Returns:
        The mean square [m^2].
    """
    points = path.problem.mesh.points
    return _miss(points, path.displacements, jnp.asarray(nodes), jnp.asarray(targets))


@jax.jit
def _miss(points, displacements, nodes, targets):
    middle = jnp.mean(points[nodes], axis=0)
    moved = middle[None] + jnp.mean(displacements[:, nodes], axis=1)
    return jnp.mean(jnp.sum((moved - targets) ** 2, axis=1))


class Follower:
    """Solves the equilibria of one design after the other, each from the one before.

    Newton's method starts at full load from the last displacement, and follows the load from
    rest where that does not converge: the equilibria agree unless a design has several. Where
    the load path ends too, the last equilibrium has buckled, and the body falls from there
    into a stable one (`relax_to_minimum`; not under `jit`). Derivatives are those of
    `fem.solve`, none of them by where a solve starts from. An equilibrium that is not found
    has NaN for derivatives, on which `minimise` stops.
    """

    def __init__(self, *, newton: Newton | None = None, steps: int = 1, max_cuts: int = 4):
        self.settings = (Newton() if newton is None else newton, steps, max_cuts)
        self.last: np.ndarray | None = None
        self.solutions = 0

    def __call__(self, problem: Problem) -> Solution:
        solution, u = self._solved(problem, self.last)
        if not _is_found(solution) and self.last is not None:
            solution, u = self._fallen(problem, self.last, solution)
        if not _is_found(solution):
            here = jnp.equal(jnp.asarray(solution.load_fraction), 1.0)
            valid = jnp.where(here, solution.displacement, jnp.nan)
            solution = eqx.tree_at(lambda s: s.displacement, solution, valid)
            u = None
        if u is None:
            u = jax.lax.stop_gradient(solution.displacement)
        if is_traced(u):
            tell_host(self._keep, u)
        else:
            self._keep(u)
        return solution

    def _solved(self, problem: Problem, start: np.ndarray | None):
        return solved_and_kept(problem, start, self.settings, throw=False)

    def _fallen(self, problem: Problem, start: np.ndarray, solution: Solution):
        here = without_derivatives(problem)
        if is_traced((here, solution.load_fraction)):
            return solution, None
        u, stable = relax_to_minimum(here, start)
        if not stable:
            return solution, None
        return self._solved(problem, u)

    def _keep(self, u) -> None:
        u = np.asarray(u)
        self.solutions += 1
        if np.all(np.isfinite(u)):
            self.last = u


def _is_found(solution: Solution) -> bool:
    """Whether it is known to be an equilibrium at full load; nothing is, in a trace."""
    fraction = solution.load_fraction
    return not is_traced(fraction) and bool(np.all(np.asarray(fraction) == 1.0))
