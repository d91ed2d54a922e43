"""Algebra of implicit shapes in the plane and in space: what is cut, what is left of it.

The shapes of section V-A of the Sorotoki paper, one unit being 10 mm: a square turned by 45
degrees without a disc, and a cube without one ball and within another. The paper's listing
turns by `pi/4`, which its code reads as degrees; here it is an angle in radians.
"""

import io
import math
import sys
from pathlib import Path

import jax
import jax.numpy as jnp

import sorojax as sj
from sorojax import sdf
from sorojax.units import deg, mm

UNIT = 10 * mm
PLANE, SPACE = 1 - math.pi / 4, 5 * math.pi / 24  # area and volume of what is left, in units


def shapes():
    square = sdf.rotate(sdf.Rectangle([0, 0], [UNIT, UNIT]), 45 * deg)
    disc = sdf.Circle([0, 0], UNIT)
    cube = sdf.Box([0, 0, 0], [UNIT, UNIT, UNIT])
    small = sdf.Sphere([0, 0, UNIT], UNIT / 2)
    large = sdf.Sphere([0, 0, UNIT / 2], UNIT)
    return (square, disc, square - disc), (cube, cube - small, (cube - small) / large)


def main(quick: bool = False, picture: str | None = None) -> dict[str, float]:
    flat, solid = shapes()
    left, carved = flat[-1], solid[-1]
    counted = {} if quick else {
        "volume over its exact value, less 1": float(sdf.volume(carved) / UNIT**3 / SPACE - 1)
    }  # fmt: skip

    # Inside, the field is the distance to the nearest point of the outline.
    inside = sdf.sample_interior(left, 200, key=jax.random.key(0))
    outline = jnp.concatenate([curve.points for curve in sdf.contour(left, UNIT / 1000)])
    nearest = jnp.linalg.norm(inside[:, None] - outline[None], axis=2).min(axis=1)

    # Around the solid its slope is one, and a point finds the surface.
    lower, upper = sdf.bounding_box(carved)
    around = jax.random.uniform(jax.random.key(1), (2000, 3), minval=lower, maxval=upper)
    near = around[jnp.abs(carved(around)) < 0.1 * UNIT]
    slope = jnp.linalg.norm(sdf.gradient(carved, near), axis=1)
    landed = sdf.project(carved, near)

    surface = sdf.isosurface(carved, UNIT / (24 if quick else 64), "dual_contouring")
    report = sdf.surface_report(surface)
    if picture is not None:
        draw((*flat, *solid), Path(picture))
    return {
        "area over its exact value, less 1": float(sdf.area(left) / UNIT**2 / PLANE - 1),
        **counted,
        "field off the distance inside [mm]": float(jnp.abs(left(inside) + nearest).max() / mm),
        "slope off one": float(jnp.abs(slope - 1).max()),
        "points off the surface [mm]": float(jnp.abs(carved(landed)).max() / mm),
        "triangles": len(surface.triangles),
        "fit to print": float(report.watertight and report.printable),
        "volume of the triangles over the exact value": report.volume / UNIT**3 / SPACE,
    }


def draw(shapes, file: Path) -> None:
    """What the operations begin with and what they leave, in the plane and in space."""
    import matplotlib.pyplot as plt

    names = ("square", "disc", "square - disc",
             "cube", "cube - small ball", "(cube - small ball) / large ball")  # fmt: skip
    solid = {"view": sj.view.Camera(-125.0, 28.0), "renderer": "own"}
    figure, axes = plt.subplots(2, 3, figsize=(11, 7))
    for place, shape, name in zip(axes.flat, shapes, names, strict=True):
        shown = sj.view.show(shape, **(solid if shape.dim == 3 else {}))
        place.imshow(plt.imread(io.BytesIO(shown.png)))
        place.set_title(name, fontsize=11)
        place.set_axis_off()
        plt.close(shown.figure)
    figure.tight_layout()
    figure.savefig(file, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    names = [name for name in sys.argv[1:] if name != "--quick"]
    for name, number in main("--quick" in sys.argv, *names[:1]).items():
        print(f"{name:46s} {number:10.4g}")
