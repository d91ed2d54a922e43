"""Arms: inertia, bias and Jacobians beside MuJoCo; balance and speed of one with a finger."""

import importlib.util
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, measure, missing, quick
from sorojax import io, robots, rod
from sorojax.io._mujoco import parser

STATES = 20
EXAMPLE = Path(__file__).parents[2] / "examples" / "40_arm_picks_ball.py"
WORST = "MuJoCo, worst entry of 20 random states over the largest"
BALANCE = "Newton and Euler over every joint, worst over the largest, while the ball is carried"


def rows():
    for name in ("iiwa7", "ur5e", "gen3"):
        yield from beside_mujoco(name)
    if not quick("an arm with a finger that picks a ball"):
        yield picked()


def beside_mujoco(name):
    try:
        mujoco = parser("benchmarks")
    except ModuleNotFoundError as reason:
        yield missing("mujoco", str(reason), arm=name)
        return
    text = robots.arm_mjcf(name)
    theirs, arm = mujoco.MjModel.from_xml_string(text), io.import_robot(text)
    data, draw = mujoco.MjData(theirs), np.random.default_rng(0)
    dof, worst = theirs.nv, np.zeros(3)

    def ours(q, v):
        model = arm.assembly
        rows = rod.jacobian(model, q)
        return (
            rod.mass_matrix(model, q),
            rod.bias_force(model, q, v, arm.gravity),
            jnp.stack([rows[part][0] for part in arm.joints.values()]),
        )

    timing = measure(ours, jnp.zeros(dof), jnp.zeros(dof))
    ours = jax.jit(ours)
    for _ in range(STATES):
        data.qpos[:], data.qvel[:] = draw.uniform(-2.5, 2.5, dof), draw.normal(size=dof)
        mujoco.mj_forward(theirs, data)
        mass, spin, move = np.zeros((dof, dof)), np.zeros((3, dof)), np.zeros((3, dof))
        for row, unit in zip(mass, np.eye(dof), strict=True):
            mujoco.mj_mulM(theirs, data, row, unit)
        jacobians = []
        for part in arm.joints.values():
            mujoco.mj_jacBody(theirs, data, move, spin, theirs.body(part).id)
            jacobians.append(np.concatenate([spin, move]))
        wanted = mass, data.qfrc_bias, np.stack(jacobians)
        found = ours(jnp.array(data.qpos), jnp.array(data.qvel))
        pairs = zip(found, wanted, strict=True)
        off = [np.abs(a - b).max() / np.abs(b).max() for a, b in pairs]
        worst = np.maximum(worst, off)
    for quantity, error in zip(("mass matrix", "bias force", "Jacobians"), worst, strict=True):
        yield Row(
            "sorojax",
            {"case": name, "quantity": quantity, "dof": dof},
            **timing.columns(),
            error=float(error),
            reference=WORST,
            bar=1e-9,
            bar_on="error",
        )


def picked() -> Row:
    """The example: computing time of a simulated second, and the balance on the way."""
    script = example()
    setup = script.scene()
    ticks = jnp.array(script.PERIOD * np.arange(round(3.4 / script.PERIOD)))
    start = time.process_time()
    jax.block_until_ready(script.run(setup, ticks))
    first = time.process_time() - start
    start = time.process_time()
    q, v = jax.block_until_ready(script.run(setup, ticks))
    run = time.process_time() - start
    return Row(
        "sorojax",
        {"case": "arm with finger", "dof": v.shape[1], "simulated_s": float(ticks[-1])},
        compile_s=first - run,
        run_s=run / float(ticks[-1]),
        error=unbalanced(script.forces, setup, ticks, q, v),
        reference=BALANCE,
        bar=1e-8,
        bar_on="error",
    )


def example():
    """The script of the example, as a module."""
    spec = importlib.util.spec_from_file_location("arm_picks_ball", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def unbalanced(forces, setup, ticks, q, v) -> float:
    """Worst moment or force that a joint carries beyond what the parts behind it need, over the
    largest of its kind in that joint, ten times a second while the ball is in the air."""
    up = np.flatnonzero(np.asarray(ticks) > 2.0)[::25]
    at = ticks[up], q[up], v[up]
    found, needed = eqx.filter_jit(_balance)(forces, setup, at)
    off = np.abs(found - needed).reshape(*found.shape[:-1], 2, 3)
    size = np.abs(needed).reshape(off.shape).max(axis=(0, 3))
    return float((off.max(axis=(0, 3)) / size).max())


def _balance(forces, setup, at):
    """Of each joint but that of the ball, which is free: what it carries and what all parts
    behind it need, the change of their momentum less their weight, about the origin."""

    def one(t, q, v):
        whole, acting = setup[1], forces(setup, t, q, v)
        rates, a = rod.vector_field(whole, acting)(t, (q, v))
        carried = rod.joint_wrenches(whole, q, v, a, acting, t=t)
        _, change = jax.jvp(lambda *at: rod.part_momenta(whole, *at), (q, v), (rates, a))
        poses, here = rod.forward_kinematics(whole, q, [0.0]), rod.motion(whole, q)
        found, needed = [], []
        for k, name in enumerate(whole.names):
            part, wrench = rod.part_motion(here, k), carried[name]
            weight = part.operators.mass[:, None] * jnp.array([[0.0, 0.0, -9.81]])
            turning = jnp.sum(jnp.cross(part.position, weight), axis=0)
            needed.append(change[name] - jnp.append(turning, jnp.sum(weight, axis=0)))
            found.append(wrench.at[:3].add(jnp.cross(poses[name][0, :3, 3], wrench[3:])))
        behind = jnp.cumsum(jnp.stack(needed)[::-1], axis=0)[::-1]
        return jnp.stack(found[:-1]), behind[:-1]

    return jax.lax.map(lambda at: one(*at), at)
