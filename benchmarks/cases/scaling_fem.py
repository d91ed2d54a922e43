"""Assembly, factorisation and solution of blocks from 10^2 to 10^5.5 unknowns.

Factors of nested dissection take n^1.5 operations and n log n numbers in the plane, n^2
operations and n^(4/3) numbers in space. Memory is that of all parts at a size together,
with the mesh, the analysis of the pattern and what compiling takes.
"""

from itertools import count

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import memory, scaling
from benchmarks.blocks import bent, block
from benchmarks.harness import Timing, measure_calls, quick
from sorojax import fem, mesh
from sorojax.fem.equilibrium.linear import constrain, linearise, prepare

PLANE, SPACE = (6, 21, 69, 222, 397), (6, 13, 25)  # cells a side


def parts(element: mesh.AbstractElement, side: int) -> dict[str, scaling.Point]:
    """What a Newton iteration consists of."""
    timings: dict[str, Timing] = {}
    sizes: list[int] = []

    def run():
        problem = block(element, (side,) * element.dim, fem.Displacement())
        sizes.append(problem.space.num_dofs)
        timings.update(_timings(problem))

    most = memory.peak(run)
    return {name: scaling.Point(sizes[0], t, most) for name, t in timings.items()}


def _timings(problem: fem.Problem) -> dict[str, Timing]:
    prepared, u = prepare(problem), bent(problem.mesh.points)
    system = problem.space.system
    state = jax.block_until_ready(linearise(problem, prepared, u, u))
    zero = jnp.zeros_like(state.residual)
    held = constrain(system, state.values, state.residual, prepared.known, zero)
    matrix, rhs = map(np.asarray, held)
    number = count(1)

    def factor():
        # other values every time: factors of known values are kept
        return system.solver.factor(matrix * (1 + 1e-9 * next(number)))

    held_factor = factor()
    calls = {
        "assembly": lambda: linearise(problem, prepared, u, u),
        "factor": factor,
        "solve": lambda: held_factor.solve(rhs),  # type: ignore
    }
    return {name: measure_calls(call, repeats=3) for name, call in calls.items()}


def rows():
    few = quick("the largest size of each element, and of Quad4 the two smallest")
    plane, space = (PLANE[2:-1], SPACE[:-1]) if few else (PLANE, SPACE)
    for element, sides, powers in (
        (mesh.Quad4(), plane, {"assembly": 1.0, "factor": 1.5, "solve": 1.0}),
        (mesh.Hex8(), space, {"assembly": 1.0, "factor": 2.0, "solve": 4 / 3}),
    ):
        found = [parts(element, side) for side in sides]
        for name, expected in powers.items():
            what = f"{name}, {element.name}"
            yield from scaling.rows(what, "dof", expected, (p[name] for p in found))
