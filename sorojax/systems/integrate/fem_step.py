"""One implicit step of finite-element bodies together with what a network answers.

Unknown are the displacements u of the bodies, where the forces of the step act, and the
values w of their loads and driven supports at its end. With the equilibrium R(u, w) = 0 of the
bodies, inertia included, and what the rest of the network makes of their motion and of the
reactions at driven supports, w = W(u, w), the equations of Newton's method are

    [  K       B   ] [du]     [  R  ]
    [-W_u   1 - W_w] [dw] = - [w - W]

solved by block elimination: the right-hand sides R and B take one factor of the sparse K,
and the slopes of W are needed along their solutions only. Nodes that a driven support holds
move with w as it says.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from sorojax import fem
from sorojax.fem.dynamics.step import Dynamics, State, TimeStep, held_within
from sorojax.fem.equilibrium import rules
from sorojax.fem.equilibrium.linear import Linearised, Prepared, linearise
from sorojax.fem.equilibrium.newton import safe_fraction
from sorojax.fem.problem import load_force, residual, with_terms
from sorojax.fem.supports import known_values
from sorojax.math.linalg import sparse
from sorojax.math.ode.step_control import filled
from sorojax.systems.blocks.driven import with_places, with_values

Drives = dict[str, dict[str, Array]]  # values of driven loads and supports, by body and name
Fields = dict[str, Float[Array, "nodes dim"]]


class Stage(NamedTuple):
    """A body in a step: `state` before it, and the values of what is driven then."""

    dynamics: Dynamics
    prepared: Prepared
    state: State
    step: TimeStep
    drives: dict[str, Array]


class Equations(NamedTuple):
    """The equations of a step as functions of what it depends on.

    Attributes:
        stages: (given) -> the bodies in the step.
        answer: (given, stages, u, w) -> the values W of what is driven at the end.
    """

    stages: Callable[[Any], dict[str, Stage]]
    answer: Callable[[Any, dict[str, Stage], Fields, Drives], Drives]


class _Pass(NamedTuple):
    """A Newton iteration: trial u, w; the state `base` from which the step `du`, `dw` was
    taken, by `share`, and the slope of the energy there."""

    u: Fields
    w: Array
    base: Fields
    base_w: Array
    du: Fields
    dw: Array
    share: Float[Array, ""]
    slope: Float[Array, ""]
    shortenings: Int[Array, ""]
    iterations: Int[Array, ""]
    update: Float[Array, ""]
    converged: Bool[Array, ""]
    running: Bool[Array, ""]


def _ravelled(tree: PyTree) -> tuple[Array, Callable[[Array], PyTree]]:
    """Numbers as one vector, and back; no numbers have the precision of others by default."""
    flat, build = ravel_pytree(tree)
    return (flat if flat.size else jnp.zeros(0)), build


def search(
    equations: Equations, newton: fem.Newton, given: PyTree
) -> tuple[tuple[Fields, Drives], Bool[Array, ""]]:
    """Displacements and load values of a step, and whether they were found."""
    u, w, converged = _newton(equations, newton, given)
    return (u, w), converged


@eqx.filter_custom_jvp
def balanced(
    equations: Equations, given: PyTree, found: tuple[Fields, Drives]
) -> tuple[Fields, Drives]:
    """What `search` found, with the derivative of the equations there by the implicit function
    theorem: one tangent, one factor and as many back-substitutions as there are values."""
    return found


@balanced.def_jvp
def _balanced_jvp(primals, tangents):
    equations, given, (u, w) = primals

    def unbalanced(given):
        stages = equations.stages(given)
        forces = {k: residual(loaded(s, w[k]), u[k]).ravel() for k, s in stages.items()}
        held = {k: _held(s, w[k]) for k, s in stages.items()}
        return forces, held, _ravelled(equations.answer(given, stages, u, w))[0]

    forces, held, answer = filled(*eqx.filter_jvp(unbalanced, (given,), (tangents[1],)))
    stages = equations.stages(given)
    matrices = {
        k: linearise(loaded(s, w[k]), s.prepared, u[k], u[k]).values for k, s in stages.items()
    }
    du, dw = _solved(equations, given, matrices, stages, u, w, forces, held, -answer)
    return (u, w), (du, _ravelled(w)[1](dw))


def on_the_way(stage: Stage, values: dict[str, Array]) -> dict[str, Array]:
    """Values of what is driven where the forces of a step act."""
    af = stage.dynamics.scheme.af
    return {name: (1 - af) * values[name] + af * old for name, old in stage.drives.items()}


def loaded(stage: Stage, values: dict[str, Array]) -> fem.Problem:
    """The problem of equilibrium, its loads and supports on the way to `values`."""
    loads, supports, *others = stage.step.terms
    loads = with_values(loads, on_the_way(stage, values))
    given = stage.dynamics.problem
    if _moves_supports(stage, values):
        moved = with_places(given.supports, values)
        _, supports = held_within(moved, stage.dynamics.scheme.af, stage.state.displacement)
    return with_terms(given, (loads, supports, *others))


def _moves_supports(stage: Stage, values: dict[str, Array]) -> bool:
    """Whether supports are among what is driven."""
    return any(support.name in values for support in stage.dynamics.problem.supports)


def loaded_step(stage: Stage, values: dict[str, Array]) -> TimeStep:
    """The step with its loads and supports on the way to `values`."""
    problem = loaded(stage, values)
    terms = (problem.loads, problem.supports, *stage.step.terms[2:])
    return stage.step._replace(terms=terms)


def _held(stage: Stage, values: dict[str, Array]) -> Float[Array, " dofs"]:
    """Displacements that supports decide where the forces of the step act [m]."""
    problem = loaded(stage, values)
    return known_values(problem.supports, *stage.state.displacement.shape)


def _newton(equations: Equations, newton: fem.Newton, given):
    stages = equations.stages(given)
    start = {k: s.state.displacement for k, s in stages.items()}
    w, unravel = _ravelled({k: s.drives for k, s in stages.items()})
    zero, none = jnp.zeros((), w.dtype), jnp.zeros((), jnp.int32)
    still = jax.tree.map(jnp.zeros_like, start)
    begin = _Pass(
        {k: s.step.predicted for k, s in stages.items()},
        w,
        start,
        w,
        still,
        0 * w,
        zero + 1,
        zero,
        none,
        none,
        zero + jnp.inf,
        jnp.array(False),
        jnp.array(True),
    )

    def one(now: _Pass) -> _Pass:
        values = unravel(now.w)
        problems = {k: loaded(s, values[k]) for k, s in stages.items()}
        found = {
            k: linearise(problems[k], s.prepared, now.u[k], now.base[k])
            for k, s in stages.items()
        }
        return _judged(equations, newton, given, stages, unravel, now, problems, found)

    end = jax.lax.while_loop(lambda now: now.running, one, begin)
    return end.u, unravel(end.w), end.converged


def _judged(equations, newton, given, stages, unravel, now: _Pass, problems, found) -> _Pass:
    """The next pass: a shorter step, the end, or a new step."""
    forces = {k: _free(s.prepared.known, found[k].residual) for k, s in stages.items()}
    rise = sum(jnp.sum(forces[k] * now.du[k].ravel()) for k in stages)
    kept = jnp.min(jnp.stack([x.volume_ratio for x in found.values()]))
    fine = rules.sound(jnp.max(jnp.stack([x.residual_norm for x in found.values()])), kept)
    stepped, collapsed = now.iterations > 0, ~rules.keeps_volume(kept)
    # the prediction is no good: start from where the step does
    first = ~stepped & (collapsed | ~fine)
    shorten = collapsed | rules.turned(now.slope, rise)
    shorten = stepped & shorten & (now.shortenings < rules.MAX_SHORTENINGS)

    def again():
        def safe():
            fractions = [
                safe_fraction(problems[k], s.prepared, now.base[k], now.share * now.du[k])
                for k, s in stages.items()
            ]
            return now.share * jnp.min(jnp.stack(fractions))

        shorter = rules.shortened(now.share, now.slope, rise)
        share = jax.lax.cond(collapsed & ~first, safe, lambda: shorter)
        share = jnp.where(first, jnp.zeros_like(share), share)
        u = jax.tree.map(lambda a, b: a + share * b, now.base, now.du)
        count = now.iterations + jnp.where(first, 1, 0).astype(jnp.int32)
        return now._replace(
            u=u,
            w=now.base_w + share * now.dw,
            share=share,
            iterations=count,
            shortenings=now.shortenings + 1,
        )

    def examined():
        values = unravel(now.w)
        answer = _ravelled(equations.answer(given, stages, now.u, values))[0]
        gap = now.w - answer
        held = {k: _held(s, values[k]) for k, s in stages.items()}
        moves = {k: _move(s.prepared.known, held[k], now.u[k]) for k, s in stages.items()}
        small = _small(newton, stages, unravel, problems, found, now.u, values, gap)
        settled = ~jnp.any(jnp.stack([jnp.any(move != 0) for move in moves.values()]))
        converged = fine & rules.converged(small, now.update, settled, newton)
        stop = converged | ~fine | (now.iterations >= newton.max_iterations)

        def step():
            return _solved(
                equations,
                given,
                {k: found[k].values for k in stages},
                stages,
                now.u,
                values,
                {k: found[k].residual for k in stages},
                moves,
                gap,
            )

        still = (jax.tree.map(jnp.zeros_like, now.u), jnp.zeros_like(now.w))
        du, dw = jax.lax.cond(stop, lambda: still, step)
        new = jax.tree.map(jnp.add, now.u, du)
        sizes = [
            rules.relative_size(du[k], new[k], s.prepared.length) for k, s in stages.items()
        ]
        update = jnp.max(jnp.stack(sizes))
        slope = sum(jnp.sum(forces[k] * du[k].ravel()) for k in stages)
        slope = jnp.where(settled, slope, jnp.zeros_like(slope))
        return _Pass(
            new,
            now.w + dw,
            now.u,
            now.w,
            du,
            dw,
            jnp.ones_like(now.share),
            slope,
            jnp.zeros_like(now.shortenings),
            now.iterations + 1,
            update,
            converged,
            ~stop,
        )

    return jax.lax.cond(shorten | first, again, examined)


def _free(known, force):
    return jnp.where(known, jnp.zeros_like(force), force)


def _move(known, held, u):
    """How far the supports are from where they should be [m]."""
    return rules.left_to_move(jnp.where(known, held - u.ravel(), jnp.zeros_like(held)), held)


def _small(newton, stages, unravel, problems, found: dict[str, Linearised], u, values, gap):
    """Whether forces are balanced, and would be under the loads that the network answers, and
    driven supports are where it puts them."""
    fits = []
    for name, stage in stages.items():
        state = found[name]
        missed = unravel(gap)[name]

        def force(values, name=name, stage=stage):
            return load_force(loaded(stage, values), u[name]).ravel()

        lack = jax.jvp(force, (values[name],), (missed,))[1]
        lack = jnp.max(jnp.abs(_free(stage.prepared.known, lack)), initial=0.0)
        allowed = state.reference, state.rounding, newton.residual_tolerance
        norm = jnp.maximum(state.residual_norm, lack)  # of which neither may be NaN
        fits.append(rules.balanced(norm, *allowed))
        if _moves_supports(stage, values[name]):
            off = jax.jvp(lambda v, s=stage: _held(s, v), (values[name],), (missed,))[1]
            size = rules.relative_size(off, u[name], stage.prepared.length)
            fits.append(size < newton.step_tolerance)
    return jnp.all(jnp.stack(fits))


def _solved(equations, given, matrices, stages, u: Fields, values: Drives, forces, moves, gap):
    """du, dw of the bordered equations: tangents `matrices`, unbalanced `forces`, supports
    that move by `moves`, and the `gap` w - W."""
    w, unravel = _ravelled(values)
    first: dict[str, Array] = {}
    columns: dict[str, Array] = {}
    for name, stage in stages.items():
        system, known = stage.dynamics.problem.space.system, stage.prepared.known
        values_of, matrix = matrices[name], sparse.fix(system, matrices[name], known)

        def answered(force, move, system=system, known=known, values=values_of, matrix=matrix):
            """The displacement that balances a force, held nodes moving by `move`."""
            left = force - sparse.product(system, values, move)
            return sparse.solve(system, matrix, _free(known, left)) + move

        def force(w, name=name, stage=stage):
            return load_force(loaded(stage, unravel(w)[name]), u[name]).ravel()

        first[name] = answered(-forces[name], moves[name])
        pull = jax.jacfwd(force)(w).T  # what a unit of each value adds
        if not _moves_supports(stage, values[name]):
            pull = jnp.where(known[None], jnp.zeros_like(pull), pull)
            columns[name] = jax.vmap(lambda b, s=system, m=matrix: sparse.solve(s, m, b))(pull)
            continue
        lead = jax.jacfwd(lambda w, n=name, s=stage: _held(s, unravel(w)[n]))(w).T
        columns[name] = jax.vmap(answered)(pull, lead)

    def along(rows, dw):
        """How the answer moves with the bodies, and with the values themselves."""
        dots = {k: row.reshape(u[k].shape) for k, row in rows.items()}

        def answer(u, w):
            return equations.answer(given, stages, u, unravel(w))

        return _ravelled(jax.jvp(answer, (u, w), (dots, dw))[1])[0]

    eye = jnp.eye(w.shape[0], dtype=w.dtype)
    seen = jax.vmap(along)(columns, eye).T
    dw = jnp.linalg.solve(eye - seen, along(first, jnp.zeros_like(w)) - gap)
    du = {k: (first[k] + dw @ rows).reshape(u[k].shape) for k, rows in columns.items()}
    return du, dw
