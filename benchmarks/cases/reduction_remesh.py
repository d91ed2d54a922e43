"""Cost of a closed loop and its gradient by the drawing, on a mesh that was moved to a design
and on a new mesh of it: what a design loop jumps by where it meshes again.

A bellows actuator, mixed cells; wall -0.24, gap +0.32, base +0.16 and chamber +0.8 mm from the
drawing that the first mesh was made of. `error` of the cost is relative; that of the gradient
is the largest difference, each component scaled by its number, over the largest component.
Modes are combined of smooth functions, as samples of the strain jump from cell to cell.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import loops
from benchmarks.harness import Row, quick
from sorojax import robots, rod
from sorojax.units import mm

MOST = 1e-3
STEPS = {"wall_thickness": -0.24, "gap": 0.32, "base": 0.16, "chamber_height": 0.8}  # mm
SMOOTH: dict[str, Any] = {"samples": 161, "within": rod.Legendre(12)}
DURATION = 1.0  # s


def rows():
    sizes = (
        (0.7 * mm,) if quick("cells of 0.5 and 0.35 mm") else (0.7 * mm, 0.5 * mm, 0.35 * mm)
    )
    first = robots.BellowsActuator()
    changed = {name: getattr(first, name) + step * mm for name, step in STEPS.items()}
    second = dataclasses.replace(first, **changed)
    for size in sizes:
        moved = _of(loops.bellows(size, DURATION, mixed=True), second, first)
        fresh = _of(loops.bellows(size, DURATION, mixed=True, **changed), second)
        cost, slopes = (a - b for a, b in zip(moved, fresh, strict=True))
        found = {"cost": abs(cost) / fresh[0], "gradient": np.abs(slopes).max()}
        found["gradient"] /= np.abs(fresh[1]).max()
        for of, error in found.items():
            bar = MOST if size == sizes[-1] and len(sizes) > 1 else None
            yield Row(
                "sorojax",
                {"of": of, "cell_mm": size / mm},
                error=float(error),
                reference="a new mesh",
                bar=bar,
                bar_on="error" if bar else "",
            )


def _of(robot: loops.Robot, at: Any, start: Any = None) -> tuple[float, np.ndarray]:
    """Cost and scaled gradient at an actuator, on the mesh of `start` if that is given."""
    way: dict[str, Any] = {}
    if start is not None:
        way = {"before": (start.body(), start.layer()), "stages": 16}
    loop = loops.Loop(robot, **SMOOTH)
    here = _flat(at)
    numbers = loop.numbers.at[: here.size].set(here)

    def cost(numbers):
        return robot.cost(loop.run(numbers, loop.near, **way))

    value, slopes = jax.value_and_grad(cost)(numbers)
    return float(value), np.nan_to_num(np.asarray(slopes[: here.size] * here))


def _flat(actuator: Any) -> jax.Array:
    numbers = jax.tree.leaves(eqx.filter(actuator, eqx.is_inexact_array))
    return jnp.concatenate([jnp.ravel(x) for x in numbers])
