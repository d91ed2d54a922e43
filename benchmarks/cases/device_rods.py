"""Fingers in batches on an accelerator: accelerations and steps, against one CPU core."""

import jax.numpy as jnp

from benchmarks import devices
from benchmarks.cases.scaling_batch import STEPS, accelerations, ends
from benchmarks.fingers import finger, random_states
from benchmarks.harness import quick

SHARED = 4096  # members that both devices take, and that errors are counted of
ERRORS = {True: 1e-9, False: 2e-3}  # double precision or single


def rows():
    cpu, *others = devices.found()
    if not others:
        yield devices.absent()
        return
    large = 2**15 if quick() else 2**18
    body = finger(8)
    q, v = (jnp.asarray(x) for x in random_states(SHARED))
    # the same states again and again, so that errors are known for all
    many = tuple(jnp.tile(x, (large // SHARED, 1)) for x in (q, v))
    kinds = ("acceleration", accelerations, 1), ("step", ends, STEPS)
    for what, function, calls in kinds:
        exact = devices.on_cpu(function, body, q, v)
        for double in (True, False):
            for count, states, where in (
                (SHARED, (q, v), [cpu, *others]),
                (large, many, others),
            ):
                yield from devices.compared(
                    what,
                    function,
                    (body, *states),
                    count=count,
                    of="members",
                    calls=calls,
                    error_of=devices.relative(exact),
                    bar=ERRORS[double],
                    double=double,
                    reference="CPU in double precision",
                    devices=where,
                )
