"""Blocks of rubber for timing: the meshes, the bent state and the CPU clock."""

import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from benchmarks.rows import Timing
from sorojax import fem, material, mesh

#: Element by name and cells along each side of the block, 20 to 60 thousand unknowns.
BLOCKS = {
    "Tri3": (mesh.Tri3(), (120, 120)),
    "Quad4": (mesh.Quad4(), (158, 158)),
    "Tri6": (mesh.Tri6(), (78, 78)),
    "Tri7": (mesh.Tri7(), (66, 66)),
    "Quad9": (mesh.Quad9(), (78, 78)),
    "Tet10": (mesh.Tet10(), (12, 12, 12)),
    "Tet15": (mesh.Tet15(), (8, 8, 8)),
    "Hex8": (mesh.Hex8(), (25, 25, 25)),
}
POISSON_RATIO = 0.45


def block(
    element: mesh.AbstractElement,
    divisions: tuple[int, ...],
    formulation: Any = None,
    poisson_ratio: float = POISSON_RATIO,
) -> fem.Problem:
    """A unit square or cube, held on the left and pulled down on the right by dead load."""
    dim = element.dim
    make = mesh.rectangle if dim == 2 else mesh.box
    cells = make([0] * dim, [1] * dim, divisions=divisions, element=element)  # type: ignore
    pull = jnp.zeros(dim).at[1].set(-0.02)
    return fem.problem(
        cells,
        material.neo_hookean(young_modulus=1.0, poisson_ratio=poisson_ratio),
        kinematics=fem.PlaneStrain(1.0) if dim == 2 else fem.Solid(),
        supports=(fem.Fixed(cells.node_sets["left"]),),
        loads=(fem.Traction(cells.facet_sets["right"], pull),),
        formulation=formulation,
    )


def bent(points: jax.Array) -> jax.Array:
    """A smooth displacement with strains of about 10 %."""
    x, y = points[:, 0], points[:, 1]
    rest = [0.02 * x * y] if points.shape[1] == 3 else []
    return jnp.stack([0.05 * jnp.sin(2 * y) * x, -0.08 * x**2, *rest], axis=1)


def softened(problem: fem.Problem) -> Iterator[fem.Problem]:
    """`problem` again and again, each softer by a billionth: the solver keeps the factors of
    matrices that it has seen."""
    for number in itertools.count(1):
        numbers, rest = eqx.partition(problem.material, eqx.is_inexact_array)
        softer = jax.tree.map(lambda x, n=number: x * (1 - 1e-9 * n), numbers)
        yield eqx.tree_at(lambda p: p.material, problem, eqx.combine(softer, rest))


def cpu_timing(call: Callable[[], Any], repeats: int) -> Timing:
    """CPU seconds of this process for each call; other programs do not count."""
    wall = time.perf_counter()
    jax.block_until_ready(call())
    first, runs = time.perf_counter() - wall, []
    for _ in range(repeats):
        start = time.process_time()
        jax.block_until_ready(call())
        runs.append(time.process_time() - start)
    return Timing(max(0.0, first - min(runs)), tuple(runs))


def merged(*timings: Timing) -> Timing:
    """Runs of several rounds together; the compile time of the first."""
    return Timing(timings[0].compile_s, sum((t.runs for t in timings), ()))
