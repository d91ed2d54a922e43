"""Impacts of rods on thin obstacles, over speeds, walls and steps: what gets through, and the
largest energy over that before, for rods against shapes, rods, links and themselves."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row
from sorojax import rod as R, sdf
from sorojax.contact import LinePenalty
from sorojax.math.lie import SE2
from sorojax.math.status import Status
from sorojax.rod.dynamics.fields import RodState

STEPS = (2e-5, 2e-4, 1e-3)  # [s]
SAVES, BETWEEN = 150, 16  # steps of a run; places between two of them that are looked at
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


def run_of(scene: Scene, stepper=None):
    """(speed, wall, step) -> status, whether anything got through, largest energy over the
    first: of motion, of shape and of contact."""

    @eqx.filter_jit
    def run(speed, wall, step):
        model, forces = scene.build(wall)
        q, v = scene.begin(model, speed, wall)
        path = R.rollout(model, q, v, forces, step=step, saves=SAVES, stepper=stepper)

        def energy(q, v):
            return R.kinetic_energy(model, q, v) + R.potential_energy(model, q)

        total = jax.vmap(energy)(path.q, path.v)
        shares = jnp.linspace(0.0, 1.0, BETWEEN + 1)[1:, None, None]
        places = path.q[None, :-1] + shares * (path.q[1:] - path.q[:-1])[None]
        met = jax.lax.map(
            lambda q: scene.met(R.motion(model, q), wall), places.reshape(-1, q.shape[0])
        )
        return path.status, jnp.any(met), jnp.max(total) / total[0], total[-1] / total[0]

    return run


def rows():
    for name, scene in SCENES.items():
        run = run_of(scene)
        for step in STEPS:
            through, unresolved, ratios = [], 0, []
            for speed in scene.speeds:
                for wall in scene.walls:
                    status, met, most, _ = run(*(jnp.asarray(x) for x in (speed, wall, step)))
                    through += [f"{speed:g} m/s, {1e3 * wall:g} mm"] if met else []
                    unresolved += int(status != Status.successful)
                    ratios.append(float(most))
            settings = {
                "kind": name, "step": step, "runs": len(ratios), "unresolved": unresolved,
                "through": len(through), "which": "; ".join(through),
            }  # fmt: skip
            yield Row(
                "sorojax",
                settings | {"quantity": "through"},
                error=len(through) / len(ratios),
                reference="none",
                bar=0.0,
                bar_on="error",
            )
            yield Row(
                "sorojax",
                settings | {"quantity": "energy after over before"},
                error=max(ratios),
                reference="1",
                bar=GAINED,
                bar_on="error",
            )
