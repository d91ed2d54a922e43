"""One implicit step of finite-element bodies together with what a network answers.

Unknown are the displacements u of the bodies, where the forces of the step act, and the
values w of their loads at its end. With the equilibrium R(u, w) = 0 of the bodies, inertia
included, and what the rest of the network makes of their motion, w = W(u), the equations
of Newton's method are

    [ K   B] [du]     [  R  ]
    [-W'  1] [dw] = - [w - W]

solved by block elimination: the right-hand sides R and B take one factor of the sparse K,
and W' is needed along their solutions only.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from sorojax import fem
from sorojax.fem.dynamics.step import Dynamics, State, TimeStep
from sorojax.fem.equilibrium import rules
from sorojax.fem.equilibrium.linear import Linearised, Prepared, linearise
from sorojax.fem.equilibrium.newton import safe_fraction
from sorojax.fem.problem import load_force, residual, with_terms
from sorojax.fem.supports import known_values
from sorojax.math.linalg import sparse
from sorojax.math.ode.step_control import filled
from sorojax.systems.blocks.fem_body import with_values

Drives = dict[str, dict[str, Array]]  # values of driven loads, by body and load
Fields = dict[str, Float[Array, "nodes dim"]]


class Stage(NamedTuple):
    """A body in a step: `state` before it, and the values of its loads then."""

    dynamics: Dynamics
    prepared: Prepared
    state: State
    step: TimeStep
    drives: dict[str, Array]


class Equations(NamedTuple):
    """The equations of a step as functions of what it depends on.

    Attributes:
        stages: (given) -> the bodies in the step.
        answer: (given, u) -> the values W of their loads at the end.
    """

    stages: Callable[[Any], dict[str, Stage]]
    answer: Callable[[Any, Fields], Drives]


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


@eqx.filter_custom_jvp
def balanced(
    equations: Equations, newton: fem.Newton, given: PyTree
) -> tuple[Fields, Drives, Bool[Array, ""]]:
    """Displacements and load values of a step, and whether they were found.

    The derivative is that of the equations, by the implicit function theorem: one tangent,
    one factor and as many back-substitutions as there are values, however many iterations
    there were.
    """
    return _newton(equations, newton, given)


@balanced.def_jvp
def _balanced_jvp(primals, tangents):
    equations, newton, given = primals
    u, w, converged = found = _newton(equations, newton, given)
    u, w = jax.lax.stop_gradient((u, w))

    def unbalanced(given):
        stages = equations.stages(given)
        forces = {k: residual(_loaded(s, w[k]), u[k]).ravel() for k, s in stages.items()}
        held = {k: known_values(s.step.terms[1], *u[k].shape) for k, s in stages.items()}
        return forces, held, _ravelled(equations.answer(given, u))[0]

    forces, held, answer = filled(*eqx.filter_jvp(unbalanced, (given,), tangents[2:]))
    stages = equations.stages(given)
    matrices = {
        k: linearise(_loaded(s, w[k]), s.prepared, u[k], u[k]).values for k, s in stages.items()
    }
    du, dw = _solved(equations, given, matrices, stages, u, w, forces, held, -answer)
    return found, (du, _ravelled(w)[1](dw), None)


def _loaded(stage: Stage, values: dict[str, Array]) -> fem.Problem:
    """The problem of equilibrium, its driven loads on the way to `values`."""
    af = stage.dynamics.scheme.af
    now = {name: (1 - af) * values[name] + af * old for name, old in stage.drives.items()}
    loads, *others = stage.step.terms
    return with_terms(stage.dynamics.problem, (with_values(loads, now), *others))


def loaded_step(stage: Stage, values: dict[str, Array]) -> TimeStep:
    """The step with its driven loads on the way to `values`."""
    loads = _loaded(stage, values).loads
    return stage.step._replace(terms=(loads, *stage.step.terms[1:]))


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
        problems = {k: _loaded(s, values[k]) for k, s in stages.items()}
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
        answer = _ravelled(equations.answer(given, now.u))[0]
        gap = now.w - answer
        held = {k: known_values(s.step.terms[1], *now.u[k].shape) for k, s in stages.items()}
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
    """Whether forces are balanced, and would be under the loads that the network answers."""
    fits = []
    for name, stage in stages.items():
        state = found[name]
        missed = unravel(gap)[name]

        def force(values, name=name, stage=stage):
            return load_force(_loaded(stage, values), u[name]).ravel()

        lack = jax.jvp(force, (values[name],), (missed,))[1]
        lack = jnp.max(jnp.abs(_free(stage.prepared.known, lack)), initial=0.0)
        allowed = state.reference, state.rounding, newton.residual_tolerance
        norm = jnp.maximum(state.residual_norm, lack)  # of which neither may be NaN
        fits.append(rules.balanced(norm, *allowed))
    return jnp.all(jnp.stack(fits))


def _solved(equations, given, matrices, stages, u: Fields, values: Drives, forces, moves, gap):
    """du, dw of the bordered equations: tangents `matrices`, unbalanced `forces`, supports
    that move by `moves`, and the `gap` w - W."""
    w, unravel = _ravelled(values)
    first: dict[str, Array] = {}
    columns: dict[str, Array] = {}
    for name, stage in stages.items():
        system, known = stage.dynamics.problem.space.system, stage.prepared.known
        matrix = sparse.fix(system, matrices[name], known)

        def force(w, name=name, stage=stage):
            return load_force(_loaded(stage, unravel(w)[name]), u[name]).ravel()

        move = moves[name]
        left = -forces[name] - sparse.product(system, matrices[name], move)
        first[name] = sparse.solve(system, matrix, _free(known, left)) + move
        pull = jax.jacfwd(force)(w).T  # what a unit of each value adds
        pull = jnp.where(known[None], jnp.zeros_like(pull), pull)
        columns[name] = jax.vmap(lambda b, s=system, m=matrix: sparse.solve(s, m, b))(pull)

    def along(rows):
        """How the answer moves with the bodies."""
        dots = {k: row.reshape(u[k].shape) for k, row in rows.items()}
        tangent = jax.jvp(lambda u: equations.answer(given, u), (u,), (dots,))[1]
        return _ravelled(tangent)[0]

    eye = jnp.eye(w.shape[0], dtype=w.dtype)
    dw = jnp.linalg.solve(eye - jax.vmap(along)(columns).T, along(first) - gap)
    du = {k: (first[k] + dw @ rows).reshape(u[k].shape) for k, rows in columns.items()}
    return du, dw
