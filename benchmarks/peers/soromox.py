"""The D1 finger in soromox, and one that stretches and twists too.

Run by its own interpreter: `python -I soromox.py FOLDER`. Answers coordinates strain by strain,
in the order of their names: the modes of kappa_y, then of kappa_z.
"""

import json
import os
import sys
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from soromox.actuation import ThreadlikeActuator, ThreadlikeRouting  # noqa: E402
from soromox.systems import SystemState  # noqa: E402
from soromox.systems.components import IsotropicMaterialParams, JointSpec, LinkSpec  # noqa: E402
from soromox.systems.gvs import GVS, GVSSegment, StrainBasisSpec  # noqa: E402

ORDERS = (0, 1, 1, 0, 0, 0)  # of kappa_x, kappa_y, kappa_z, sigma_x, sigma_y, sigma_z
clock = time.process_time if os.environ.get("SOROJAX_BENCH_CPU") == "1" else time.perf_counter


def finger(num_nodes, strains, orders):
    """With polynomials of such orders for the strains that are named."""
    link = LinkSpec.circular(
        length=0.08,
        radius=0.006,
        young_modulus=1e6,
        poisson_ratio=0.3,
        density=2000.0,
        reference_strain=[0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
    )
    basis = StrainBasisSpec("chebyshev", tuple(strains), orders)
    return clamped(link, basis, num_nodes, [0.0, 0.0, -9.81])


def clamped(link, basis, num_nodes, gravity, **more):
    """One link on a base that stays."""
    segment = GVSSegment(
        link=link, joint=JointSpec(type="fixed"), basis=basis, num_gauss_points=num_nodes
    )
    # Its base pose is a scalar-last quaternion and a position.
    base = jnp.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    return GVS.from_segments([segment], gravity=jnp.array(gravity), base_pose=base, **more)


def bending(request):
    """The finger that bends only, with as many modes of both curvatures."""
    return finger(request["nodes"], ("kappa_y", "kappa_z"), request["modes"] - 1)


def measure(function, *args, repeats):
    start = clock()
    compiled = jax.jit(function).lower(*args).compile()
    compile_s = clock() - start
    result = jax.block_until_ready(compiled(*args))
    runs = []
    for _ in range(repeats):
        start = clock()
        jax.block_until_ready(compiled(*args))
        runs.append(clock() - start)
    return result, {"compile_s": compile_s, "runs": runs}


def acceleration(request, arrays):
    """Accelerations at (q, v), and the time of one in a compiled loop."""
    robot = bending(request)
    states = jnp.concatenate([arrays["q"], arrays["v"]], axis=-1)
    half = arrays["q"].shape[-1]

    def loop(y):
        def body(_, y):
            return y + 1e-9 * robot.forward_dynamics(0.0, y)

        return jax.lax.fori_loop(0, request["calls"], body, y)

    _, timing = measure(loop, states[0], repeats=request["repeats"])
    timing["runs"] = [run / request["calls"] for run in timing["runs"]]
    rates = jax.jit(lambda y: robot.forward_dynamics(0.0, y))
    return timing, {"a": np.stack([rates(y)[half:] for y in states])}


def simulation(request, arrays):
    """Tips of the released finger every `save_dt`, without the first."""
    robot = bending(request)
    rest = jnp.zeros(2 * robot.num_internal_dofs)

    def tips(y):
        states = robot.rollout_to(
            SystemState(t=0.0, y=y),
            t1=request["duration"],
            solver_dt=request["dt"],
            save_dt=request["save_dt"],
            max_steps=None,
        )
        half = y.size // 2
        pose = jax.vmap(lambda y: robot.forward_kinematics(y[:half], robot.length))
        return pose(states.y)[:, :3, 3]

    result, timing = measure(tips, rest, repeats=request["repeats"])
    return timing, {
        "tips": np.asarray(result)[-round(request["duration"] / request["save_dt"]) :]
    }


def chambered(request):
    """The finger of `sorojax.envs.FingerReach`: it hangs, and air in chambers moves it."""
    angles = 2 * np.pi * np.arange(request["chambers"]) / request["chambers"]
    sides = np.stack([0 * angles, np.cos(angles), np.sin(angles)], axis=1)
    chambers = ThreadlikeActuator.pressure_chambers(
        ThreadlikeRouting.linear(intercept=jnp.asarray(request["chamber_offset"] * sides)),
        effective_areas=jnp.full(request["chambers"], request["chamber_area"]),
    )

    def built(damping):
        link = LinkSpec.circular(
            length=request["length"],
            radius=request["radius"],
            young_modulus=request["young_modulus"],
            poisson_ratio=request["poisson_ratio"],
            density=request["density"],
            reference_strain=[0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
            damping=damping,
        )
        basis = StrainBasisSpec("chebyshev", ("kappa_y", "kappa_z", "sigma_x"), ORDERS)
        down = [request["gravity"], 0.0, 0.0]
        return clamped(link, basis, request["nodes"], down, actuators=[chambers])

    still = built(None)
    return built(request["damping"] * still.params.link.stiffness[0])


def members(request, arrays):
    """Tips of a batch after a few steps, each member under pressures of its own."""
    robot = chambered(request)
    rest = jnp.zeros(2 * robot.num_internal_dofs)

    def tip(pressure):
        states = robot.rollout_to(
            SystemState(t=0.0, y=rest),
            u=pressure,
            t1=request["steps"] * request["dt"],
            solver_dt=request["dt"],
            save_ts=jnp.array([request["steps"] * request["dt"]]),
            max_steps=request["steps"] + 2,
        )
        q = states.y[-1, : rest.size // 2]
        return robot.forward_kinematics(q, robot.length)[:3, 3]

    pressures = jnp.asarray(arrays["pressures"])
    tips, timing = measure(jax.vmap(tip), pressures, repeats=request["repeats"])
    timing["runs"] = [run / len(pressures) for run in timing["runs"]]
    return timing, {"tips": np.asarray(tips)}


def first_calls(request, arrays):
    """Seconds of the first call and of the second of a rollout, or of its gradient.

    By Young's modulus; the end of the gradient is the sum of the last coordinates.
    """
    robot = finger(request["nodes"], request["strains"], request["orders"])
    rest = jnp.zeros(2 * robot.num_internal_dofs)
    jax.block_until_ready(jnp.zeros(3) + 1)

    def coordinates(young_modulus):
        material = IsotropicMaterialParams(young_modulus=young_modulus, poisson_ratio=0.3)
        states = robot.with_isotropic_material(material).rollout_to(
            SystemState(t=0.0, y=rest),
            t1=request["duration"],
            solver_dt=request["dt"],
            save_dt=request["save_dt"],
            max_steps=round(request["duration"] / request["dt"]) + 2,
        )
        return states.y[:, : rest.size // 2]

    function = {
        "rollout": coordinates,
        "gradient": jax.grad(lambda young: jnp.sum(coordinates(young)[-1])),
    }[request["what"]]
    call, seconds, cpu = jax.jit(function), [], []
    for _ in range(2):
        start = time.perf_counter(), time.process_time()
        result = jax.block_until_ready(call(jnp.array(1e6)))
        seconds.append(time.perf_counter() - start[0])
        cpu.append(time.process_time() - start[1])
    return {"seconds": seconds, "cpu": cpu}, {"result": np.asarray(result)}


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    request = json.loads((folder / "request.json").read_text())
    arrays = dict(np.load(folder / "request.npz"))
    answer, results = globals()[request["task"]](request, arrays)
    (folder / "answer.json").write_text(json.dumps(answer))
    np.savez(folder / "answer.npz", **results)
