"""Steps of environments in batches on an accelerator: a rod, a rod in contact, a reduced solid,
against one CPU core."""

import equinox as eqx
import jax
import jax.numpy as jnp

from benchmarks import devices
from benchmarks.harness import quick
from sorojax import envs

SHARED = 256  # members that both devices take, and that errors are counted of
ERRORS = {True: 1e-6, False: 1e-2}  # double precision or single
TASKS = {
    "finger": (envs.FingerReach, (True,)),
    "tentacle in contact": (envs.TentaclePush, (True,)),
    "reduced solid": (envs.SolidReach, (True, False)),
}  # and the precisions: rods are made in that of the process


def asked(env, members: int):
    """A step of members that begin alike, as a function and its arguments: where their markers
    are then [m], without the noise of what is observed."""
    arrays, rest = eqx.partition(env, eqx.is_array)
    params, key = env.default_params(), jax.random.key(0)
    start, _ = jax.jit(lambda key: envs.reset(env, key, params))(key)
    actions = jax.random.uniform(key, (members, env.num_actions), minval=-1.0)

    def moved(arrays, start, actions, params):
        env = eqx.combine(arrays, rest)

        def one(action):
            after = envs.step(env, jax.random.key(1), start, action, params)
            return env.markers(after.state.body, params)

        return jax.vmap(one)(actions)

    return moved, (arrays, start, actions, params)


def rows(tasks=TASKS, shared: int = SHARED):
    cpu, *others = devices.found()
    if not others:
        yield devices.absent()
        return
    large = 1024 if quick() else 8192
    for what, (make, precisions) in tasks.items():
        moved, few = asked(make(), shared)
        exact = devices.on_cpu(moved, *few)
        many = (*few[:2], jnp.tile(few[2], (large // shared, 1)), few[3])
        for double in precisions:
            for count, given, where in ((shared, few, [cpu, *others]), (large, many, others)):
                yield from devices.compared(
                    f"step of an environment, {what}",
                    moved,
                    given,
                    count=count,
                    of="members",
                    error_of=devices.relative(exact),
                    bar=ERRORS[double],
                    double=double,
                    reference="CPU in double precision",
                    devices=where,
                )
