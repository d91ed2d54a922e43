"""Random bodies from few kinds of trees, and how thin they are, measured by rays.

Trees of one kind differ in numbers only, so that each kind is compiled once.
"""

import functools

import numpy as np

from sorojax import sdf
from sorojax.sdf.sampling import values, values_and_gradients

FACING = -0.6  # cosine between the normals of both sides of a wall or a gap
_LEAVES = {
    2: ("ball", "box", "rounded", "polygon", "ring"),
    3: ("ball", "box", "rounded", "cylinder", "cone", "prism"),
}
_PAIRS = ("|", "&", "-", "-", "|", "smooth |", "smooth -")
_SINGLES = ("rotate", "shell", "offset", "rotate")


def kind(dice: np.random.Generator, dim: int, depth: int):
    """A tree without numbers: nested tuples of names."""
    if depth == 0 or dice.random() < 0.15:
        return (str(dice.choice(_LEAVES[dim])),)
    if dice.random() < 0.3:
        return (str(dice.choice(_SINGLES)), kind(dice, dim, depth - 1))
    both = (kind(dice, dim, depth - 1), kind(dice, dim, depth - 1))
    return (str(dice.choice(_PAIRS)), *both)


def body(dice: np.random.Generator, tree, dim: int, least: float) -> sdf.AbstractSdf:
    """A tree with numbers, its lengths between `least` and 1 [m]."""
    name, *parts = tree
    made = [body(dice, part, dim, least) for part in parts]
    length = functools.partial(_length, dice, least)
    if name == "rotate":
        return sdf.rotate(made[0], dice.uniform(0, 2 * np.pi), dice.uniform(-0.4, 0.4, 2))
    if name == "shell":
        return sdf.shell(made[0], length(0.4))
    if name == "offset":
        return sdf.offset(made[0], length(0.2))
    if name == "|":
        return made[0] | made[1]
    if name == "&":
        return made[0] & made[1]
    if name == "-":
        return made[0] - made[1]
    if name == "smooth |":
        return sdf.SmoothUnion(*made, length(0.3))
    if name == "smooth -":
        return sdf.SmoothDifference(*made, length(0.3))
    return _leaf(dice, name, dim, length)


def _length(dice, least: float, most: float) -> float:
    return float(np.exp(dice.uniform(np.log(min(least, most)), np.log(most))))


def _leaf(dice, name: str, dim: int, length) -> sdf.AbstractSdf:
    at = dice.uniform(-0.6, 0.6, dim)
    half = np.array([length(1.2) / 2 for _ in range(dim)])
    round_off = float(dice.uniform(0.1, 0.9) * half.min())
    if name == "ball":
        return (sdf.Circle if dim == 2 else sdf.Sphere)(at, half[0])
    if name == "box":
        return (sdf.Rectangle if dim == 2 else sdf.Box)(at - half, at + half)
    if name == "rounded":
        return (sdf.Rectangle if dim == 2 else sdf.Box)(at - half, at + half, round_off)
    if name == "polygon":
        angle = 2 * np.pi / 5 * (np.arange(5) + dice.uniform(-0.3, 0.3, 5))
        return sdf.Polygon(at + half * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    if name == "ring":
        return sdf.translate(sdf.Ring(half[0], half[0] + length(0.3)), at)
    if name == "cylinder":
        return sdf.translate(sdf.Cylinder(half[0], 2 * half[1]), at)
    if name == "cone":
        return sdf.translate(sdf.CappedCone(half[0], half[1], 2 * half[2]), at)
    return sdf.translate(sdf.HexagonalPrism(half[0], 2 * half[1]), at)


def thinnest(shape: sdf.AbstractSdf, size: float) -> float:
    """Thinnest wall or gap [m] by rays along normals, up to `size`; infinite above, NaN where
    there is no body."""
    step = size / (12 if shape.dim == 2 else 6)
    at, normal = surface_points(shape, step)
    if not len(at):
        return np.nan
    steps = size * np.r_[np.geomspace(1e-5, 0.01, 7), 0.02 * np.arange(1, 51)]
    found = np.inf
    for way in (-1.0, 1.0):
        ray = at[:, None] + way * steps[:, None] * normal[:, None]
        f = values(shape, ray.reshape(-1, shape.dim)).reshape(len(at), -1)
        # from the wall through the inside, or from outside through a gap
        crossed = (f[:, 1:] * way < 0) & (f[:, :-1] * way > 0)
        first = np.argmax(crossed, axis=1)
        rows = np.flatnonzero(crossed.any(axis=1))
        before, after = f[rows, first[rows]], f[rows, first[rows] + 1]
        share = before / (before - after)
        far = steps[first[rows]] + share * np.diff(steps)[first[rows]]
        hit = at[rows] + way * far[:, None] * normal[rows]
        facing = (_normals(shape, hit) * normal[rows]).sum(axis=1) < FACING
        found = min(found, far[facing].min(initial=np.inf))
    return float(found)


def surface_points(shape: sdf.AbstractSdf, step: float):
    """Points of the zero set about `step` apart, and outward unit normals there."""
    lower, upper = (np.asarray(corner, float) for corner in shape.bounding_box())
    axes = [np.arange(a - step, b + step, step) for a, b in zip(lower, upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, shape.dim)
    f = values(shape, grid)
    at = grid[np.abs(f) < 0.6 * np.sqrt(shape.dim) * step]
    for _ in range(6):
        f, g = values_and_gradients(shape, at)
        square = np.maximum((g * g).sum(axis=1), 1e-3)
        at = at - (f / square)[:, None] * g
    at = at[np.abs(values(shape, at)) < 1e-9]
    # the slope jumps at corners: only points that are smooth on both sides are asked
    normal = _normals(shape, at)
    smooth = np.ones(len(at), bool)
    for way in (-1, 1):
        beside = at + way * 1e-6 * normal
        smooth &= (_normals(shape, beside) * normal).sum(axis=1) > 0.99
        smooth &= way * values(shape, beside) > 0
    return at[smooth], normal[smooth]


def _normals(shape: sdf.AbstractSdf, p: np.ndarray) -> np.ndarray:
    g = values_and_gradients(shape, p)[1]
    return g / np.maximum(np.linalg.norm(g, axis=1, keepdims=True), 1e-12)
