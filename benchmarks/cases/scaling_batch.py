"""Fingers in batches of 1 to 4096, more on an accelerator: accelerations, and steps."""

import jax
import jax.numpy as jnp

from benchmarks import scaling
from benchmarks.fingers import MODES, finger, random_states
from benchmarks.harness import quick
from sorojax.math.compiled import batched
from sorojax.math.ode.steppers import GeneralisedAlpha
from sorojax.rod import Gravity, forward_dynamics, rollout

STEPS, STEP = 50, 1e-3  # s


def members() -> tuple[int, ...]:
    sizes = [8**k for k in range(5)]
    if jax.default_backend() != "cpu":
        sizes += [8**5, 8**6]
    return tuple(sizes[::4] if quick("sizes between the smallest and the largest") else sizes)


def accelerations(body, q, v):
    return batched(lambda q, v: forward_dynamics(body, q, v, (Gravity(),)))(q, v)


def ends(body, q, v):
    """Coordinates after some steps."""

    def one(q, v):
        path = rollout(
            body,
            q,
            v,
            (Gravity(),),
            step=STEP,
            saves=1,
            every=STEPS,
            stepper=GeneralisedAlpha(1.0),
        )
        return path.q[-1]

    return batched(one)(q, v)


def rows():
    body, sizes = finger(8), members()
    q, v = (jnp.asarray(x) for x in random_states(max(sizes)))
    assert q.shape[1] == 2 * MODES
    kinds = ("accelerations", accelerations, 1), ("steps", ends, STEPS)
    for name, function, calls in kinds[1:] if quick("accelerations: in rod.batch") else kinds:
        yield from scaling.rows(
            name,
            "members",
            1.0,
            (scaling.program(n, function, body, q[:n], v[:n], calls=calls) for n in sizes),
        )
