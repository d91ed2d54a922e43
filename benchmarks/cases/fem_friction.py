"""Friction: threshold and creep on a slope, and what a contact far away costs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, measure_together
from sorojax import fem, material, mesh, sdf
from sorojax.fem import linear
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
        yield Row("sorojax", found, error=error, bar=0.005, bar_on="error",
                  reference="Coulomb: g (sin - mu cos)")  # fmt: skip
    yield from _far()


def _far():
    """Assembly of residual and tangent with a contact out of reach, and without one."""
    timed, base = {}, None
    problem = block((120, 30))
    far = fem.with_load(problem, "floor", jnp.array([0.0, -1.0]))
    smooth = block((120, 30), None)
    cases = {
        "none": dataclasses.replace(problem, loads=problem.loads[:1]),
        "frictionless, far": fem.with_load(smooth, "floor", jnp.array([0.0, -1.0])),
        "friction, far": far,
    }
    u = jnp.zeros_like(problem.mesh.points)
    calls = {}
    for name, case in cases.items():
        prepared = linear.prepare(case)
        leaves, tree = jax.tree.flatten((linear.unsupported(case), prepared))

        def assemble(u, leaves=leaves, tree=tree):
            return linear.linearise(*jax.tree.unflatten(tree, leaves), u, u)

        calls[name] = assemble
    timed = measure_together(calls, u, repeats=15)
    base = min(timed["none"].runs)
    for name, timing in timed.items():
        extra = min(timing.runs) / base - 1
        bar = None if name == "none" else 0.05
        yield Row("sorojax", {"contact": name, "dof": problem.space.num_dofs,
                              "extra": round(extra, 4)}, **timing.columns(), error=extra,
                  bar=bar, bar_on="error", reference="assembly without contact")  # fmt: skip
