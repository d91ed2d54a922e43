"""A plain equation in diffrax alone: `python -I diffrax.py FOLDER`.

A chain of masses and springs, linear, by the fixed steps of Tsit5: little else has to be
compiled than the solver's own loop.
"""

import json
import sys
import time
from pathlib import Path

import diffrax as dfx
import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402


def first_calls(request, arrays):
    """Seconds of the first call and of the second of a motion, or of its gradient.

    x'' = -s A x from the positions `start` at rest. The end of the gradient is the sum of the
    last positions, by s = 1.
    """
    chain, start = jnp.asarray(arrays["chain"]), jnp.asarray(arrays["start"])
    times = jnp.linspace(0.0, request["duration"], request["saves"] + 1)
    jax.block_until_ready(jnp.zeros(3) + 1)

    def motion(stiffness):
        def field(t, state, args):
            x, v = state
            return v, -stiffness * (chain @ x)

        solution = dfx.diffeqsolve(
            dfx.ODETerm(field),
            dfx.Tsit5(),
            0.0,
            request["duration"],
            request["dt"],
            (start, jnp.zeros_like(start)),
            saveat=dfx.SaveAt(ts=times),
            max_steps=round(request["duration"] / request["dt"]) + 2,
        )
        return solution.ys[0]

    function = {
        "motion": motion,
        "gradient": jax.grad(lambda stiffness: jnp.sum(motion(stiffness)[-1])),
    }[request["what"]]
    call, seconds, cpu = jax.jit(function), [], []
    for _ in range(2):
        begin = time.perf_counter(), time.process_time()
        result = jax.block_until_ready(call(jnp.array(1.0)))
        seconds.append(time.perf_counter() - begin[0])
        cpu.append(time.process_time() - begin[1])
    return {"seconds": seconds, "cpu": cpu}, {"result": np.asarray(result)}


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    request = json.loads((folder / "request.json").read_text())
    arrays = dict(np.load(folder / "request.npz"))
    answer, results = globals()[request["task"]](request, arrays)
    (folder / "answer.json").write_text(json.dumps(answer))
    np.savez(folder / "answer.npz", **results)
