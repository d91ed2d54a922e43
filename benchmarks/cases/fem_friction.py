"""Friction: threshold and creep on a slope, and what a contact far away costs."""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, Timing, measure_together, quick
from sorojax import fem, material, mesh, sdf
from sorojax.fem.equilibrium import linear
from sorojax.units import mm

FRICTION, SIZE = 0.5, (20 * mm, 5 * mm)
SHARES = (0.9975, 1.0025)
FLOOR = sdf.HalfPlane([0.0, 0.0], [0.0, 1.0])


def block(divisions: tuple[int, int], friction: float | None = FRICTION) -> fem.Problem:
    """A free block of rubber on a floor."""
    shape = mesh.rectangle([0, 0], SIZE, divisions=divisions, element=mesh.Quad4())
    return fem.problem(
        shape,
        material.neo_hookean(young_modulus=1e6, poisson_ratio=0.3, density=1000.0),
        kinematics=fem.PlaneStrain(0.03),
        supports=(),
        loads=(
            fem.Gravity([0.0, -9.81]),
            fem.Contact(shape.facet_sets["bottom"], FLOOR, friction=friction, name="floor"),
        ),
        free=True,
    )


def slope(share: float, step: float) -> dict[str, float]:
    """Speed and acceleration on a slope that has come up to a share of the threshold."""
    angle = share * np.arctan(FRICTION)

    def gravity(t):
        now = angle * jnp.clip((t - 0.04) / 0.06, 0.0, 1.0)
        return 9.81 * jnp.stack([jnp.sin(now), -jnp.cos(now)])

    motion = fem.simulate(block((8, 2)), 0.5, step, save=6, gravity=gravity)
    speed = np.asarray(motion.velocities)[:, :, 0].mean(axis=1)
    theory = 9.81 * max(0.0, np.sin(angle) - FRICTION * np.cos(angle))
    return {
        "share_of_threshold": share,
        "speed_m_s": float(speed[-1]),
        "acceleration_m_s2": float(speed[-1] - speed[-3]) / 0.2,
        "theory_m_s2": theory,
    }


def rows():
    for share in SHARES:
        found = slope(share, 2e-3)
        off = abs(found["acceleration_m_s2"] - found["theory_m_s2"])
        # the error of the threshold that this error of the acceleration stands for
        error = off / (9.81 * np.cos(share * np.arctan(FRICTION)) * FRICTION)
        yield Row(
            "sorojax",
            found,
            error=error,
            bar=0.005,
            bar_on="error",
            reference="Coulomb: g (sin - mu cos)",
        )
    yield from _far()
    if not quick("steps in motion with a far contact"):
        yield from _far_in_motion()


def _far_cases() -> dict[str, fem.Problem]:
    """The block without a floor, and with one a metre below it."""
    problem, smooth = block((120, 30)), block((120, 30), None)
    below = jnp.array([0.0, -1.0])
    cases = {
        "none": dataclasses.replace(problem, loads=problem.loads[:1]),
        "frictionless, far": fem.with_load(smooth, "floor", below),
        "friction, far": fem.with_load(problem, "floor", below),
    }
    if quick("a far contact without friction"):
        del cases["frictionless, far"]
    return cases


def _far():
    """Assembly of residual and tangent with a contact out of reach, and without one."""
    timed, base = {}, None
    cases = _far_cases()
    problem = cases["none"]
    u = jnp.zeros_like(problem.mesh.points)
    calls = {}
    for name, case in cases.items():
        prepared = linear.prepare(case)
        leaves, tree = jax.tree.flatten((linear.unsupported(case), prepared))

        def assemble(u, leaves=leaves, tree=tree):
            return linear.linearise(*jax.tree.unflatten(tree, leaves), u, u)

        calls[name] = assemble
    timed = measure_together(calls, u, repeats=100)  # 15 were 50 ms, shorter than a hiccup
    base = min(timed["none"].runs)
    for name, timing in timed.items():
        extra = min(timing.runs) / base - 1
        bar = None if name == "none" else 0.05
        yield Row(
            "sorojax",
            {"contact": name, "dof": problem.space.num_dofs, "extra": round(extra, 4)},
            **timing.columns(),
            error=extra,
            bar=bar,
            bar_on="error",
            reference="assembly without contact",
        )


def _far_in_motion(steps: int = 20, repeats: int = 9):
    """CPU seconds of a step of a bending block in free flight, in turns."""
    cases = _far_cases()
    runs, iterations = {name: [] for name in cases}, {}
    points = np.asarray(cases["none"].mesh.points)
    speed = np.zeros_like(points)
    speed[:, 1] = 4.0 * (2 * points[:, 0] / SIZE[0] - 1) ** 2

    begin = (jnp.zeros_like(speed), jnp.asarray(speed))

    def fly(case):
        start = time.process_time()
        motion = fem.simulate(case, steps * 2e-4, 2e-4, start=begin, save=2)
        return (time.process_time() - start) / steps, motion

    compile_s = {name: fly(case)[0] * steps for name, case in cases.items()}
    for turn in range(repeats):
        for name in list(cases)[:: 1 - 2 * (turn % 2)]:
            took, motion = fly(cases[name])
            runs[name].append(took)
            iterations[name] = motion.stats.iterations
    base = min(runs["none"])
    for name, took in runs.items():
        extra = min(took) / base - 1
        settings = {
            "contact": name,
            "of": "a step in motion",
            "dof": cases[name].space.num_dofs,
            "iterations": iterations[name],
            "extra": round(extra, 4),
        }
        timing = Timing(compile_s[name], tuple(took))
        yield Row(
            "sorojax",
            settings,
            **timing.columns(),
            error=extra,
            bar=None if name == "none" else 0.05,
            bar_on="error",
            reference="a step without contact",
        )
