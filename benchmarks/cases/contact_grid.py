"""Impacts of rods on thin obstacles, over speeds, walls and steps: what gets through, and the
largest energy over that before, for rods against shapes, rods, links and themselves; of rods
against themselves also beside the grid."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row
from sorojax import rod as R, sdf
from sorojax.contact import LinePenalty
from sorojax.math.lie import SE2
from sorojax.math.ode.contact_midpoint import ContactMidpoint
from sorojax.math.ode.step_control import may_double
from sorojax.math.ode.steppers import integrate
from sorojax.math.status import Status
from sorojax.rod.dynamics.fields import RodState
from sorojax.rod.dynamics.rollout import second_order

STEPS = (2e-5, 2e-4, 1e-3)  # [s]
SAVES, BETWEEN = 150, 16  # steps of a run; places between two of them that are looked at
SEEDS, ASIDE = (0, 1), 0.15  # how far speeds, walls and steps lie beside the grid, at random
SMALLEST = 2.0**-20  # part of a step
GAINED = 1.001  # of the energy before, at most
RADIUS, SPAN, TILT, ROOM = 6e-3, 0.08, 0.3, 3e-3
LAW = LinePenalty(stiffness=5e7, smoothing=6e-6)
SOFT: Any = {"young_modulus": 1e6, "poisson_ratio": 0.3, "density": 2000.0}


class Scene(NamedTuple):
    """A kind of pair: the speeds [m/s], what is hit, across [m], and how the scene is made.

    `build` makes model and forces of a wall, `begin` coordinates and rates of a speed, and
    `met` says whether lines that must stay apart meet.
    """

    speeds: tuple[float, ...]
    walls: tuple[float, ...]
    build: Callable
    begin: Callable
    met: Callable


def flier(radius):
    """A short rod, free in the plane."""
    basis = R.chebyshev(kappa_z=2)
    rod = R.rod(SE2(), basis, R.circle(radius), length=SPAN, nodes=8, **SOFT)
    return R.Part(rod, R.Free())


def on_shape(wall):
    shape = sdf.Rectangle(jnp.stack([0 * wall - 1.0, -wall]), jnp.array([1.0, 0.0]))
    contact = R.ObstacleContact(obstacle=shape, radius=RADIUS, law=LAW, points=64, caps="both")
    return R.assembly(SE2(), rod=flier(RADIUS)), (R.PartForce("rod", contact),)


def on_rod(wall):
    model = R.assembly(SE2(), rod=flier(RADIUS), other=flier(wall / 2))
    contact = R.RodContact(
        jnp.stack([RADIUS + 0 * wall, wall / 2]), LAW, points=64, caps="both"
    )
    return model, (R.PairForce("rod", "other", contact),)


def on_link(wall):
    mass = SOFT["density"] * SPAN * wall * 2 * RADIUS
    link = R.Link(mass, mass * (SPAN**2 + wall**2) / 12)
    model = R.assembly(SE2(), rod=flier(RADIUS), plate=R.Part(link, R.Free()))
    half = jnp.stack([0 * wall + SPAN / 2, wall / 2])
    contact = R.LinkContact(sdf.Rectangle(-half, half), RADIUS, LAW, points=64, caps="both")
    return model, (R.PairForce("rod", "plate", contact),)


def on_itself(wall):
    model = R.rod(
        SE2(),
        R.chebyshev(kappa_z=3),
        R.circle(wall / 2),
        length=0.2,
        nodes=20,
        rest_strain=[29.0, 1.0, 0.0],
        **SOFT,
    )
    return model, (R.SelfContact(wall / 2, LAW, points=128),)


def falling(on: Any):
    """Tilted, the lower end 3 mm above what the rod falls on."""

    def begin(model, speed, wall):
        q = jnp.zeros(R.num_coordinates(model)) + 0 * speed
        lift = RADIUS + ROOM + (0 if on is None else wall / 2)
        q = q.at[:3].set(
            jnp.stack([TILT + 0 * wall, -0.5 * SPAN * jnp.cos(TILT) + 0 * wall, lift])
        )
        if on == "rod":
            q = q.at[6].set(-SPAN / 2)
        return q, jnp.zeros_like(q).at[2].set(-speed)

    return begin


def curling(model, speed, wall):
    """A rod at rest, 0.92 of a turn, whose tip closes it."""
    q, turn = jnp.zeros(3) + 0 * speed, jnp.array([1.0, 0.0, 0.0])
    moved = R.jacobian(model, q)[-1, 1:] @ turn
    return q, turn * speed / jnp.sqrt(moved @ moved)


def line_of(moment):
    return R.points(moment, np.linspace(0.0, 1.0, 129)).position


def below(moment, wall):
    return jnp.any(line_of(R.part_motion(moment, 0))[:, 1] < -wall)


def crossed(moment, wall):
    other = R.part_motion(moment, 1)
    if isinstance(other, RodState):
        return cross(line_of(R.part_motion(moment, 0)), line_of(other))
    ends = jnp.array([[-SPAN / 2, 0.0], [SPAN / 2, 0.0]])
    plate = other.base.position[None] + ends @ other.base.directors.T
    return cross(line_of(R.part_motion(moment, 0)), plate)


def looped(moment, wall):
    line = line_of(moment)
    return cross(line, line)


def cross(one, two):
    """Whether two lines of the plane cross; parts that share an end do not."""

    def turn(a, b, c):
        u, v = b - a, c - a
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

    a, b, c, d = one[:-1, None], one[1:, None], two[None, :-1], two[None, 1:]
    return jnp.any((turn(a, b, c) * turn(a, b, d) < 0) & (turn(c, d, a) * turn(c, d, b) < 0))


FAST = (5.0, 10.0, 20.0, 50.0, 100.0)
PLATES, CORDS = (1e-3, 2e-3, 5e-3, 1e-2, 2e-2), (3e-3, 4e-3, 6e-3, 8e-3, 1e-2)
SCENES = {
    "shape": Scene(FAST, PLATES, on_shape, falling(None), below),
    "rod": Scene(FAST, PLATES, on_rod, falling("rod"), crossed),
    "link": Scene(FAST, PLATES, on_link, falling("link"), crossed),
    "itself": Scene(FAST, CORDS, on_itself, curling, looped),
}


def met_between(scene: Scene, model, wall, q, after):
    """Whether any two lines meet on the straight ways between rows of coordinates."""
    shares = jnp.linspace(0.0, 1.0, BETWEEN + 1)[1:, None, None]
    places = q[None] + shares * (after - q)[None]
    flat = places.reshape(-1, q.shape[1])
    met = jax.lax.map(lambda q: scene.met(R.motion(model, q), wall), flat)
    return jnp.any(met.reshape(BETWEEN, -1), axis=0)


def run_of(scene: Scene, stepper=None):
    """(speed, wall, step) -> status, whether anything got through, largest energy over the
    first: of motion, of shape and of contact, and last one."""

    @eqx.filter_jit
    def run(speed, wall, step):
        model, forces = scene.build(wall)
        q, v = scene.begin(model, speed, wall)
        path = R.rollout(model, q, v, forces, step=step, saves=SAVES, stepper=stepper)

        def energy(q, v):
            return R.kinetic_energy(model, q, v) + R.potential_energy(model, q)

        total = jax.vmap(energy)(path.q, path.v)
        met = met_between(scene, model, wall, path.q[:-1], path.q[1:])
        return path, met, jnp.max(total) / total[0], total[-1] / total[0]

    method = ContactMidpoint() if stepper is None else stepper

    @eqx.filter_jit
    def states(speed, wall, step):
        model, forces = scene.build(wall)
        q, v = scene.begin(model, speed, wall)
        problem, none = second_order(model, q, forces), jnp.zeros(())
        return integrate(method, problem, q, v, t=none, h=step, saves=SAVES, every=1)[0]

    @eqx.filter_jit
    def one(wall, step, state):
        model, forces = scene.build(wall)
        problem = second_order(model, state.q, forces)
        new = method.step(problem, jnp.zeros(()), step, state)
        return new, met_between(scene, model, wall, state.q[None], new.q[None])[0]

    def judged(speed, wall, step):
        path, met, most, last = run(speed, wall, step)
        through, path_of = False, states(speed, wall, step) if met.any() else None
        for k in np.flatnonzero(met):
            begun = jax.tree.map(lambda x, k=k: x[k], path_of)
            end, parts = in_parts(partial(one, wall), step, begun)
            through |= parts or not np.allclose(end.q, path.q[k + 1], rtol=1e-3)
        return path.status, through, most, last

    return judged


def in_parts(one, step, state):
    """A step again, by the parts that it was cut into, on which coordinates move straight:
    the state after it, and whether lines met on any of these ways. A step that was not cut
    has the mean of its rates."""
    done, share, met = 0.0, 1.0, False
    while done < 1.0:
        new, meets = one(share * step, state)
        way = share * step * (state.v + new.v) / 2
        if not np.allclose(new.q - state.q, way, rtol=0, atol=1e-9 * abs(new.q).max()):
            share /= 2
            if share < SMALLEST:
                raise ValueError(f"contact.grid: no part of a step of {step} s moves straight.")
            continue
        state, done, met = new, done + share, met | bool(meets)
        share *= 2 if may_double(share, done) else 1
    return state, met


def rows():
    for name, scene in SCENES.items():
        yield from rows_of(name, scene, run_of(scene), None)
    scene = SCENES["itself"]
    for seed in SEEDS:
        yield from rows_of("itself", scene, run_of(scene), seed)


def rows_of(name, scene, run, seed):
    """Rows of a kind of pair, on the grid, or beside it by random numbers of a seed."""
    random = None if seed is None else np.random.default_rng(seed)
    for step in STEPS:
        through, unresolved, ratios = [], 0, []
        for speed in scene.speeds:
            for wall in scene.walls:
                at = np.array([speed, wall, step])
                if random is not None:
                    at *= 1 + ASIDE * random.uniform(-1, 1, 3)
                status, met, most, _ = run(*map(jnp.asarray, at))
                fine = bool(status == Status.successful)
                through += [f"{at[0]:g} m/s, {1e3 * at[1]:g} mm"] if met else []
                unresolved += not fine
                ratios.append(float(most))
        settings = {
            "kind": name,
            "step": step,
            "runs": len(ratios),
            "unresolved": unresolved,
            "through": len(through),
            "which": "; ".join(through),
        }
        settings |= {} if seed is None else {"beside the grid by seed": seed}
        yield from outcomes(settings, len(through) / len(ratios), max(ratios))


def outcomes(settings, through: float, energy: float):
    """The two rows of a set of impacts: what got through, and the largest energy after over
    that before."""
    found = {
        "through": (through, "none", 0.0),
        "energy after over before": (energy, "1", GAINED),
    }
    for quantity, (error, reference, bar) in found.items():
        at = settings | {"quantity": quantity}
        yield Row("sorojax", at, error=error, reference=reference, bar=bar, bar_on="error")
