"""Mass matrix, bias and tip of the finger D1 at a drawn state, against 40 nodes."""

import jax.numpy as jnp

from benchmarks.fingers import LENGTH, finger, random_states
from benchmarks.harness import Row, measure_calls
from sorojax.rod import bias_force, forward_kinematics, mass_matrix

BARS = {"mass": 1e-9, "bias": 1e-9, "tip": 1e-9}
REFERENCE = "40 nodes: largest entry of the difference over that of the value, tip over length"


def rows():
    qs, vs = random_states(1)
    q, v = jnp.array(qs[0]), jnp.array(vs[0])
    verbs = {
        "mass": lambda rod: mass_matrix(rod, q),
        "bias": lambda rod: bias_force(rod, q, v),
        "tip": lambda rod: jnp.asarray(forward_kinematics(rod, q, [1.0]))[0, :3, 3],
    }
    fine = {name: verb(finger(40)) for name, verb in verbs.items()}
    for nodes in (5, 6, 8, 10, 12):
        rod = finger(nodes)
        for name, verb in verbs.items():
            timing = measure_calls(lambda: verb(rod), 3)  # noqa: B023
            size = LENGTH if name == "tip" else jnp.abs(fine[name]).max()
            error = float(jnp.abs(verb(rod) - fine[name]).max() / size)
            yield Row(
                "sorojax",
                {"nodes": nodes, "verb": name},
                **timing.columns(),
                error=error,
                reference=REFERENCE,
                bar=BARS[name] if nodes == 8 else None,
                bar_on="error",
            )
