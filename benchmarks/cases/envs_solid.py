"""The finger of finite elements in its task beside the whole one: where the tip is, and what a
step of each method costs, in double and in single precision.

Commands of both sides are drawn, and held for 0.2 s each; the whole finger moves by
`fem.simulate` under the pressures that the supply delivers.
"""

import itertools
import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, measure, measure_once
from benchmarks.single import narrow
from sorojax import envs, fem, systems
from sorojax.envs import solids
from sorojax.envs.supply_line import begun, sent
from sorojax.envs.tasks.solid_finger import MAX_PRESSURE, PORTS, SolidFinger, full_finger
from sorojax.systems.blocks.modal_body import ModalBody
from sorojax.units import mm

WORKERS = 1  # nothing here calls the host
SEEDS = (101, 102, 103, 104)  # of commands that nothing was chosen by
HELD, CHANGES, FINE = 10, 6, 16  # steps of the task, commands, states of the whole in a step
BAR = 1e-2
MEMBERS, STEP_BAR, MEMBER_BAR = (1, 64, 1024, 4096), 200e-6, 50e-6
PRECISIONS = ("double", "single")


def actions(seed: int) -> np.ndarray:
    """Of the steps of the task: each side alone first, then both."""
    drawn = np.random.default_rng(seed).uniform(-1, 1, (CHANGES, len(PORTS)))
    drawn[0], drawn[CHANGES // 2] = [1.0, -1.0], [-1.0, 1.0]
    return np.repeat(drawn, HELD, axis=0)


def pressures(env, acts: np.ndarray) -> np.ndarray:
    """What is delivered [Pa], `FINE` times in each step."""
    params, supplied = env.default_params(), begun(jnp.zeros(len(PORTS)))
    rows = [np.zeros(len(PORTS))]
    for each in acts:
        command = params.max_pressure * (1 + jnp.asarray(each)) / 2
        delivery, supplied = sent(params.supply, supplied, command, env.period)
        for k in range(1, FINE + 1):
            rows.append(np.asarray(delivery(jnp.asarray(k / FINE * env.period))))
    return np.stack(rows)


def whole_tip(env, acts: np.ndarray) -> np.ndarray:
    """Where the tip of the whole finger is at the end of each step [m]."""
    full = full_finger()
    given = dict(zip(PORTS, jnp.asarray(pressures(env, acts).T), strict=True))
    hung = fem.solve(full.loaded({name: jnp.zeros(()) for name in PORTS})).displacement
    motion = fem.simulate(
        full.problem,
        len(acts) * env.period,
        env.period / FINE,
        start=(hung, jnp.zeros_like(hung)),
        damping=full.damping,
        **given,
    )
    _, node = full.markers[-1]
    moved = np.asarray(motion.displacements[FINE::FINE, node])
    return np.asarray(full.problem.mesh.points[node]) + moved


def reduced_tip(env, acts: np.ndarray, precision: str = "double") -> np.ndarray:
    """That of the task [m]."""
    env, params, acts = in_precision((env, env.default_params(), jnp.asarray(acts)), precision)
    state, _ = envs.reset(env, jax.random.key(0), params)

    def one(state, act):
        after = envs.step(env, jax.random.key(1), state, act, params)
        return after.state, (env.markers(after.state.body, params)[-1], after.info["diverged"])

    tips, diverged = jax.jit(lambda s: jax.lax.scan(one, s, acts)[1])(state)
    assert not diverged.any()
    return np.asarray(tips)


def in_precision(tree, precision: str):
    return narrow(tree) if precision == "single" else tree


def error_of(tips: np.ndarray, want: np.ndarray) -> tuple[float, float]:
    """Largest distance of two paths of the tip, and the largest move from the start [m]."""
    off = np.linalg.norm(tips - want, axis=1).max()
    return float(off), float(np.linalg.norm(want - want[0], axis=1).max())


def by_steps(
    body: SolidFinger,
    given: jax.Array | np.ndarray,
    period: float,
    step: float,
    implicit: float,
):
    """The tip by the steps of the task, or backward Euler, under delivered pressures [m]."""
    small = body.reduced.body
    solid, times = solids.Solid(small, jnp.ones(())), _times(given, period)

    def one(state, begin):
        def air(t):
            return jax.vmap(lambda row: jnp.interp(begin + t, times, row))(given.T)

        count = round(period / step)
        after = solids.rolled(solid, state, air, time_step=step, steps=count, implicit=implicit)
        return after, solids.places(small, after.q)[-1]

    start = solids.settled(solid, jnp.zeros(len(PORTS)))
    return jax.lax.scan(one, start, jnp.asarray(times[:-1:FINE]))[1]


def by_network(body: SolidFinger, given: jax.Array | np.ndarray, period: float, step: float):
    """The same by Rosenbrock steps in a network."""
    small = body.reduced.body
    start = solids.settled(solids.Solid(small, jnp.ones(())), jnp.zeros(len(PORTS))).q
    times, ports = _times(given, period), [f"body.{name}_pressure" for name in PORTS]
    network = systems.Network({"body": small}, {}, exposed=tuple(ports))
    film = systems.simulate(
        network,
        times[-1],
        state={"body": {"q": start, "v": jnp.zeros_like(start)}},
        inputs={
            port: lambda t, row=row: jnp.interp(t, times, row)
            for port, row in zip(ports, given.T, strict=True)
        },
        save=len(given) // FINE + 1,
        step=step,
        solver=systems.Rosenbrock2(refresh=True),
    )
    return film["body.marker_4_position"][1:]


def _times(given: jax.Array | np.ndarray, period: float) -> np.ndarray:
    return period / FINE * np.arange(len(given))


def rows():
    start = time.perf_counter()
    body = envs.solid_finger(keep=False)
    took = time.perf_counter() - start
    found, env = body.reduced, envs.SolidReach(body=body)
    sizes = len(found.body.basis), len(found.cells), found.num_cells
    settings = dict(zip(("shapes", "cells", "of"), sizes, strict=True))
    share = 100 * float(found.share)
    for seed in SEEDS:
        acts = actions(seed)
        want = whole_tip(env, acts)
        for precision in PRECISIONS:
            off, move = error_of(reduced_tip(env, acts, precision), want)
            known = {"largest move [mm]": move / mm, "points [%]": share, **settings}
            asked = {"quantity": "tip in the task", "commands": seed, "precision": precision}
            yield Row(
                "sorojax",
                asked | known,
                error=off / move,
                reference="fem.simulate, over its largest move",
                bar=BAR,
                bar_on="error",
                compile_s=took,
            )
    given = jnp.asarray(pressures(env, acts))
    fine = np.asarray(by_steps(body, given, env.period, 1e-4, 0.5))
    methods = {
        "midpoint": lambda step: by_steps(body, given, env.period, step, 0.5),
        "backward Euler": lambda step: by_steps(body, given, env.period, step, 1.0),
        "Rosenbrock2, refreshed": lambda step: by_network(body, given, env.period, step),
    }
    for name, method in methods.items():
        for step in (4e-3, 2e-3, 1e-3):
            timing, tips = measure_once(jax.jit(lambda m=method, h=step: m(h)))
            steps = round(len(acts) * env.period / step)
            yield Row(
                "sorojax",
                {"quantity": "a step", "method": name, "step [ms]": 1e3 * step},
                **timing.per(steps).columns(),
                error=error_of(np.asarray(tips), fine)[0] / move,
                reference="midpoint in steps of 0.1 ms, over the largest move",
            )
    for members, precision in itertools.product(MEMBERS, PRECISIONS):
        steps = 500 if members == 1 else 50
        air = jax.random.uniform(jax.random.key(0), (members, len(PORTS))) * MAX_PRESSURE
        solid, held = in_precision((body.reduced.body, air), precision)
        timing = measure(lambda air, b=solid, n=steps: held_steps(b, n, air), held, repeats=3)
        asked = {"quantity": "a step of a member", "step [ms]": 4.0, "members": members}
        yield Row(
            "sorojax",
            asked | {"precision": precision},
            **timing.per(steps * members).columns(),
            bar=STEP_BAR if members == 1 else MEMBER_BAR,
            bar_on="run_s",
        )


def held_steps(body: ModalBody, count: int, held: jax.Array):
    """Members after steps of the task from rest, each under its own pressures [Pa]."""
    solid, zero = solids.Solid(body, jnp.ones((), body.q.dtype)), jnp.zeros_like(body.q)
    start = solids.SolidBody(zero, zero)

    def run(air):
        return solids.rolled(solid, start, lambda t: air, time_step=4e-3, steps=count)

    return jax.vmap(run)(held)
