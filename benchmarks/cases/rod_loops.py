"""Closed loops in motion: how well they stay closed, what they cost over the open tree."""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row
from sorojax import rod
from sorojax.math.lie import SE2, SE3, homogeneous
from sorojax.math.ode.steppers import DormandPrince, GeneralisedAlpha
from sorojax.rod.dynamics.closures import violations

RUN = 10.0  # s
GAP_BAR, DRIFT_BAR, COST_BAR, GRADIENT_BAR = 1e-10, 1e-6, 2.0, 1e-6
SOFT: dict[str, Any] = {"young_modulus": 1e6, "poisson_ratio": 0.5, "density": 1000.0}
DAMPED = (rod.Gravity(), rod.Damping(0.02))
SAVES = 50
FINE = {"four-bar": 1e-4, "three rods": 2e-4}  # s, of the method of order 5
REFERENCES = {
    "violation": "|g(q, t)| at most [rad], [m], in 10 s",
    "energy": "largest change in 10 s, relative",
    "gradient": "central differences",
    "cost": "CPU time of the open tree, run in turn",
}


def four_bar():
    """Three soft links of 4 coordinates and their joints; the ground is the fourth."""
    basis = rod.chebyshev(kappa_z=3, sigma_x=1)
    lengths = (0.1, 0.25, 0.2)
    links = [
        rod.rod(SE2(), basis, rod.circle(8e-3), length=x, nodes=8, **SOFT) for x in lengths
    ]
    tree = rod.assembly(
        SE2(),
        crank=rod.Part(links[0], rod.Revolute()),
        coupler=rod.Part(links[1], rod.Revolute(), on="crank"),
        rocker=rod.Part(links[2], rod.Revolute(), on="coupler"),
    )
    ground = homogeneous(jnp.eye(2), jnp.array([0.3, 0.0]))
    loop = rod.with_closures(tree, pin=rod.Closure("rocker", rod.Spherical(), offset=ground))
    guess = rod.rest(tree).at[jnp.array([0, 5, 10])].set(jnp.array([1.0, -0.5, -1.5]))
    return loop, rod.close_loops(loop, guess).q


def three_rods():
    """Three soft rods clamped to the ground and to a platform: two loops in space."""
    basis = rod.chebyshev(kappa_x=1, kappa_y=3, kappa_z=3, sigma_x=1)
    leg = rod.rod(SE3(), basis, rod.circle(4e-3), length=0.2, nodes=8, **SOFT)
    up = jnp.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    places = [
        0.05 * jnp.array([np.cos(x), np.sin(x), 0.0]) for x in 2 * np.pi / 3 * np.arange(3)
    ]
    legs = {
        f"leg_{k}": rod.Part(leg, offset=homogeneous(up, place))
        for k, place in enumerate(places)
    }
    down = homogeneous(up.T, -up.T @ places[0])
    platform = rod.Link(0.03, [2e-5, 2e-5, 4e-5])
    tree = rod.assembly(SE3(), **legs, platform=rod.Part(platform, on="leg_0", offset=down))
    loop = rod.with_closures(
        tree,
        **{
            f"foot_{k}": rod.Closure(f"leg_{k}", on="platform", offset=homogeneous(up, at))
            for k, at in enumerate(places)
            if k
        },
    )
    return loop, rod.rest(loop)


def moved(loop, q, stepper, step, seconds, forces=(), size=1.0):
    """A run from rates that close the loops after the projection at the start."""
    v = size * jnp.asarray(np.random.default_rng(0).normal(size=rod.num_dof(loop)))
    every = round(seconds / step / SAVES)
    settings = {"step": step, "saves": SAVES, "every": every, "check": False}
    return rod.rollout(loop, q, v, forces, stepper=stepper, **settings)


def gap(loop, path):
    """Largest violation of a path."""
    found = jax.vmap(lambda q: violations(rod.motion(loop, q), jnp.zeros(())))(path.q)
    return float(jnp.max(jnp.abs(found)))


def drift(loop, path):
    """Largest change of the energy, relative."""

    def energy(q, v):
        return rod.kinetic_energy(loop, q, v) + rod.potential_energy(loop, q)

    found = jax.vmap(energy)(path.q, path.v)
    return float(jnp.max(jnp.abs(found - found[0])) / found[0])


def cost(loop, q, stepper, step):
    """CPU time of a run over that of the open tree from the same state: medians of runs in
    turn."""
    tree = rod.Assembly(loop.group, loop.names, loop.parts)
    zero, settings = jnp.zeros(rod.num_dof(loop)), {"step": step, "saves": 20, "every": 20}

    def run(model):
        return rod.rollout(model, q, zero, DAMPED, stepper=stepper, check=False, **settings).q

    times = {True: [], False: []}
    for model in (loop, tree):
        jax.block_until_ready(run(model))
    for model in (loop, tree) * 25:
        start = time.process_time()
        jax.block_until_ready(run(model))
        times[model is loop].append(time.process_time() - start)
    return float(np.median(times[True]) / np.median(times[False]))


def gradient(loop, q):
    """Derivative of a damped run by the stiffness of all rods, forward and in reverse, over
    that of central differences."""

    def end(scale):
        model = jax.tree.map(lambda x: x, loop)
        for k, part in enumerate(loop.parts):
            if isinstance(part.body, rod.Rod):
                young = part.body.material.young_modulus * scale
                model = eqx.tree_at(
                    lambda m, k=k: m.parts[k].body.material.young_modulus, model, young
                )
        path = rod.rollout(
            model,
            q,
            jnp.zeros(rod.num_dof(loop)),
            DAMPED,
            step=2e-3,
            saves=1,
            every=50,
            check=False,
        )
        return jnp.sum(path.q[-1])

    one, h = jnp.ones(()), 1e-4
    want = (end(one + h) - end(one - h)) / (2 * h)
    forward, reverse = jax.jvp(end, (one,), (one,))[1], jax.grad(end)(one)
    return max(abs(float(x / want - 1)) for x in (forward, reverse))


def rows():
    for name, make in (("four-bar", four_bar), ("three rods", three_rods)):
        loop, q = make()
        settings = {"model": name, "dof": rod.num_dof(loop)}

        def row(of, error, bar, settings=settings, **more):
            reference = REFERENCES[of]
            more = settings | {"of": of} | more
            return Row(
                "sorojax", more, error=error, reference=reference, bar=bar, bar_on="error"
            )

        path = moved(loop, q, DormandPrince(), FINE[name], RUN)
        yield row("energy", drift(loop, path), DRIFT_BAR, step=FINE[name])
        yield row("violation", gap(loop, path), GAP_BAR, method="DormandPrince")
        path = moved(loop, q, GeneralisedAlpha(), 2e-3, RUN, DAMPED)
        yield row("violation", gap(loop, path), GAP_BAR, method="GeneralisedAlpha")
        yield row("gradient", gradient(loop, q), GRADIENT_BAR)
        for stepper, step in ((GeneralisedAlpha(), 2e-3), (DormandPrince(), FINE[name])):
            ratio = cost(loop, q, stepper, step)
            yield row("cost", ratio, COST_BAR, method=type(stepper).__name__)
