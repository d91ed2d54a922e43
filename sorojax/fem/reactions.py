"""Reactions: what supports exert on a body, at rest and in motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._display import displayed, number
from sorojax._jax.jit import once
from sorojax._jax.trace_state import is_traced
from sorojax._types import Numbers, real
from sorojax.fem.dynamics.masses import swing_force, with_masses
from sorojax.fem.dynamics.newton import has_lists, lists_of, with_lists
from sorojax.fem.dynamics.step import (
    Dynamics,
    Row,
    State,
    StepState,
    damping_matrix,
    loads_at,
    matter,
)
from sorojax.fem.dynamics.trajectory import Trajectory
from sorojax.fem.equilibrium.jit import known_mask
from sorojax.fem.equilibrium.solve import Path
from sorojax.fem.kinematics import Axisymmetric
from sorojax.fem.loads.loads import Pressure
from sorojax.fem.problem import Problem, body, exchanged, residual
from sorojax.fem.relaxation import at_instant
from sorojax.fem.supports import AbstractSupport, known_components, known_values
from sorojax.math.linalg import sparse


@displayed
class Reaction(eqx.Module):
    """What the supports of one name exert on the body.

    `forces` [N] act on `nodes` in the components that are held there, `force` [N] is their
    sum and `moment` [N m] theirs about a point, one component in the plane and three in
    space. Where two supports hold one component of a node, it counts for the later one. Of a
    body of revolution the sum is along the axis, and there is no moment.
    """

    nodes: Int[Array, " nodes"]
    forces: Float[Array, "... nodes dim"]
    force: Float[Array, "... dim"]
    moment: Float[Array, "... turns"]

    def _text(self) -> str:
        force, moment = number(self.force, "N"), number(self.moment, "N m")
        return f"Reaction on {self.nodes.size} nodes: force {force}, moment {moment}"


def reactions(
    problem: Problem, u: Float[Array, "nodes dim"], *, about: Numbers | None = None
) -> dict[str, Reaction]:
    """What every support exerts on a body in equilibrium, by the name of the support.

    The force at a held component of a node is the slope of the total potential energy by its
    displacement. With the loads the reactions are in balance, moments included.

    Args:
        problem: Body, supports and loads; supports of one name count together.
        u: Displacement of the nodes at equilibrium [m].
        about: Point that moments are about [m]; the origin by default.

    Returns:
        Force at every held node, resultant force [N] and moment [N m], by name.

    Raises:
        ValueError: If `about` is no point.

    Example:
        >>> bar = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1),
        ...                      element=mesh.Quad9())
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1000)
        >>> problem = fem.problem(
        ...     bar, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...     supports=(fem.Fixed(bar.node_sets["left"], name="wall"),),
        ...     loads=(fem.Gravity(),))
        >>> wall = fem.reactions(problem, fem.solve(problem).displacement)["wall"]
        >>> print(f"{float(wall.force[1]):.4f} N, {float(wall.moment[0]) * 1e3:.3f} N mm")
        0.0392 N, 0.785 N mm

    Reference:
        Bathe, Finite Element Procedures, 1996.
    """
    about = _point("fem.reactions", problem, about)
    return _split(problem, about, u, balance(problem, u))


def reaction_force(
    problem: Problem, u: Float[Array, "nodes dim"], nodes: Int[Array, " nodes"]
) -> Float[Array, " dim"]:
    """Force that the supports of `nodes` exert on the body [N].

    Args:
        problem: The boundary value problem.
        u: Displacement of the nodes [m].
        nodes: Numbers of supported nodes.

    Returns:
        Force [N].
    """
    return jnp.sum(balance(problem, u)[nodes], axis=0)


def reaction_history(
    motion: Trajectory | Path, *, about: Numbers | None = None
) -> dict[str, Reaction]:
    """What every support exerts on a body in motion or along a path, by name, at every state.

    Of equilibria it is that of `reactions`, with what a body remembers there. In motion the
    force is M a + C v + f_int(u) - f_ext(t) at the held components. There a is that of
    the given motion, by differences on the grid of steps, elsewhere the one that balances the
    state; so reactions are of second order in the step, as u and v are.

    Args:
        motion: What `fem.simulate`, `solve_path` or `continuation` returned; supports of one
            name count together.
        about: Point that moments are about [m]; the origin by default.

    Returns:
        Forces [N] and moments [N m] by name, with a leading axis of saved times or states.

    Raises:
        ValueError: If `about` is no point.

    Example:
        >>> bar = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1),
        ...                      element=mesh.Quad9())
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1000)
        >>> problem = fem.problem(
        ...     bar, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...     supports=(fem.Fixed(bar.node_sets["left"], name="wall"),),
        ...     loads=(fem.Gravity(),))
        >>> motion = fem.simulate(problem, duration=0.02, step=5e-3)
        >>> fem.reaction_history(motion)["wall"].force.shape
        (5, 2)
    """
    problem = motion.problem
    about = _point("fem.reaction_history", problem, about)
    if isinstance(motion, Path):
        forces = _path_forces(motion)
    else:
        lists = None
        if has_lists(problem) and not is_traced((problem, motion.displacements)):
            lists = lists_of(problem, motion.displacements)
        forces = _motion_forces(motion.dynamics, motion.states, motion.points, lists)
    each = jax.vmap(lambda u, force: _split(problem, about, u, force))
    found = each(motion.displacements, forces)
    return {name: eqx.tree_at(lambda r: r.nodes, r, r.nodes[0]) for name, r in found.items()}


@jax.jit
def balance(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, "nodes dim"]:
    """Internal force less the loads at every node [N]: reactions at supports, where pressures
    act on their facets alone, also on the edges of an open cavity."""
    force = residual(problem, u)
    pressures = [load for load in problem.loads if isinstance(load, Pressure)]
    if not pressures:
        return force
    held = known_mask(problem.supports, *u.shape).reshape(u.shape)
    beyond = sum((load.edge_force(problem, u) for load in pressures), jnp.zeros_like(u))
    return force - jnp.where(held, beyond, jnp.zeros_like(u))


def _point(where: str, problem: Problem, about: Numbers | None) -> Float[Array, " dim"]:
    dim = problem.mesh.element.dim
    if about is None:
        return jnp.zeros(dim, problem.mesh.points.dtype)
    about = real(about).astype(problem.mesh.points.dtype)
    _check.shape(where, "about", about, (dim,), "Give one coordinate per axis.")
    return about


def _split(problem: Problem, about, u, force) -> dict[str, Reaction]:
    """Nodal forces at the supports, by name."""
    owner = _owners(problem.supports, u)
    found = {}
    for name in dict.fromkeys(support.name for support in problem.supports):
        own = [k for k, support in enumerate(problem.supports) if support.name == name]
        held = sum((owner == k for k in own), start=jnp.zeros_like(owner, bool))
        field = jnp.where(held, force, jnp.zeros_like(force))
        nodes = jnp.concatenate([problem.supports[k].nodes for k in own])
        total, moment = wrench(problem, field, problem.mesh.points + u - about[None])
        found[name] = Reaction(nodes, field[nodes], total, moment)
    return found


def _owners(supports: tuple[AbstractSupport, ...], u) -> Int[Array, "nodes dim"]:
    """Which support decides each component; -1 where none does."""
    owner = jnp.full(u.shape, -1, jnp.int32)
    for k, support in enumerate(supports):
        for component in known_components(support, u.shape[1]):
            owner = owner.at[support.nodes, component].set(k)
    return owner


def wrench(
    problem: Problem, forces: Float[Array, "nodes dim"], arms: Float[Array, "nodes dim"]
) -> tuple[Float[Array, " dim"], Float[Array, " turns"]]:
    """Sum of forces on nodes [N], and that of their moments [N m] at `arms` [m]."""
    total = jnp.sum(forces, axis=0)
    if isinstance(problem.kinematics, Axisymmetric):
        return total.at[0].set(0.0), jnp.zeros_like(total[:1])
    if arms.shape[1] == 2:
        turns = arms[:, 0] * forces[:, 1] - arms[:, 1] * forces[:, 0]
    else:
        turns = jnp.cross(arms, forces)
    return total, jnp.atleast_1d(jnp.sum(turns, axis=0))


@once
def _path_forces(path: Path) -> Float[Array, "steps nodes dim"]:
    """Internal force less the loads at every state: zero but at supports [N]."""
    states = jnp.arange(path.displacements.shape[0])
    return jax.lax.map(lambda k: balance(path.problem_at(k), path.displacements[k]), states)


# A body in motion: the acceleration of every node at an instant


@once
def _motion_forces(dynamics: Dynamics, states: State, points, lists):
    """M a + C v + f_int - f_ext at the saved states: zero but at supports [N]."""
    problem, known = dynamics.problem, matter(dynamics)
    system = problem.space.system
    rows, rest = eqx.partition(states, eqx.is_inexact_array)
    driven = _driven_accelerations(dynamics, states.displacement[0])
    driven = driven[jnp.minimum(points, driven.shape[0] - 1)]
    mask = known_mask(problem.supports, *states.displacement.shape[1:])

    def one(row):
        state, a, at, index = eqx.combine(row[0], rest), row[1].ravel(), row[2], row[3]
        left = _without_inertia(dynamics, known, state, index, at)
        mass = with_masses(problem, state.displacement, known.mass)
        matrix = sparse.fix(system, mass, mask)
        pulled = -left - sparse.product(system, mass, a)
        free = sparse.solve(system, matrix, jnp.where(mask, jnp.zeros_like(pulled), pulled))
        return left + sparse.product(system, mass, a + free)

    forces = jax.lax.map(one, (rows, driven, lists, points))
    return forces.reshape(states.displacement.shape)


def _without_inertia(dynamics: Dynamics, known, state: State, index, lists):
    """C v + f_int - f_ext at an instant [N]."""
    problem, u, v = dynamics.problem, state.displacement, state.velocity
    none = jnp.zeros((), u.dtype)
    bare = body(problem)
    now = StepState(u, v, u, none, u, state.time, none)
    loads = loads_at(dynamics, state, lambda row: row[index])
    loads = loads if lists is None else with_lists(loads, lists)
    loads = tuple(load.begun(bare, now) for load in loads)
    loaded = at_instant(bare, known.moduli, state.strains, state.peaks)
    loaded = exchanged(loaded, loads=loads, supports=problem.supports)
    force = balance(loaded, u).ravel()
    force = force + swing_force(problem, u, v).ravel()
    damping = damping_matrix(dynamics, known, u)
    if damping is None:
        return force
    return force + sparse.product(problem.space.system, damping, v.ravel())


def _driven_accelerations(dynamics: Dynamics, u) -> Float[Array, "grid nodes dim"]:
    """Accelerations of the held nodes [m/s^2] on the grid of times: central differences, of
    second order at the ends too."""
    supports, grid = dynamics.problem.supports, _grid(dynamics.supports)
    if grid is None:
        return jnp.zeros((1, *u.shape), u.dtype)

    def at(index):
        moved = []
        for support, row in zip(supports, dynamics.supports, strict=True):
            if row is not None and support.ramped is not None:
                field = support.ramped
                support = eqx.tree_at(lambda s, f=field: getattr(s, f), support, row[index])
            moved.append(support)
        return known_values(tuple(moved), *u.shape).reshape(u.shape)

    places = jax.vmap(at)(jnp.arange(grid))
    if grid < 3:
        return jnp.zeros_like(places)
    inner = (places[2:] - 2 * places[1:-1] + places[:-2]) / dynamics.step**2
    first, last = inner[:1], inner[-1:]
    if grid > 3:
        first, last = 2 * first - inner[1:2], 2 * last - inner[-2:-1]
    return jnp.concatenate([first, inner, last])


def _grid(rows: tuple[Row | None, ...]) -> int | None:
    """Number of times of what supports follow."""
    return next((row.shape[0] for row in rows if row is not None), None)
