"""Twenty printed parts as STL files hold them, made by trimesh and manifold3d [mm]."""

import numpy as np


def parts() -> dict:
    """`trimesh.Trimesh` of each part and its thinnest wall [mm], by name.

    Raises:
        ImportError: If trimesh or manifold3d is not installed.
    """
    import manifold3d  # noqa: F401  what trimesh.boolean calls
    import trimesh

    made = {}
    for count in (12, 24, 48, 96):
        wall = 2 * np.cos(np.pi / count)  # between the middles of the facets
        made[f"tube, {count} facets"] = (
            trimesh.creation.annulus(8, 10, 20, sections=count),
            wall,
        )
        made[f"closed tube, {count} facets"] = _hollow(trimesh, count), wall
    made["dense tube"] = trimesh.creation.annulus(8, 10, 20, sections=512), 2.0
    for holes in (1, 4, 9):
        made[f"plate, {holes} holes"] = _plate(trimesh, holes), 4.0
    made["box with bosses"] = _bosses(trimesh), 2.0
    made["open box"] = (
        _cut(trimesh, _box(trimesh, 30, 20, 12), _box(trimesh, 26, 16, 12, up=2)),
        2.0,
    )
    made["block"] = _box(trimesh, 20, 10, 6), 6.0
    made["hollow chamfered block"] = (
        _cut(trimesh, _chamfered(trimesh, 24, 3), _chamfered(trimesh, 20, 3)),
        2.0,
    )
    for folds, around in ((3, 32), (4, 64), (3, 400)):
        made[f"bellows, {folds} folds, {around} facets"] = _bellows(trimesh, folds, around), 1.8
    ball = trimesh.creation.uv_sphere(12, count=[150, 320])
    made["dense hollow ball"] = _cut(trimesh, ball, trimesh.creation.icosphere(4, 9)), 3.0
    return made


def _cut(trimesh, body, *tools):
    return trimesh.boolean.difference([body, *tools], engine="manifold")


def _moved(body, *offset):
    body.apply_translation(offset)
    return body


def _box(trimesh, x, y, z, up=0.0):
    return _moved(trimesh.creation.box([x, y, z]), 0, 0, up)


def _hollow(trimesh, count):
    outer = trimesh.creation.cylinder(10, 20, sections=count)
    return _cut(trimesh, outer, trimesh.creation.cylinder(8, 16, sections=count))


def _plate(trimesh, holes):
    side = int(np.sqrt(holes))
    at = 10.0 * (np.arange(side) - (side - 1) / 2)
    drills = [
        _moved(trimesh.creation.cylinder(2.5, 20, sections=32), x, y, 0) for x in at for y in at
    ]
    return _cut(trimesh, _box(trimesh, 36, 32, 4), *drills)


def _bosses(trimesh):
    shell = _cut(trimesh, _box(trimesh, 36, 26, 14), _box(trimesh, 32, 22, 14, up=2))
    bosses = [
        _moved(trimesh.creation.cylinder(3.5, 9, sections=32), x, y, -1.5)
        for x in (-11, 11)
        for y in (-6, 6)
    ]
    drills = [
        _moved(trimesh.creation.cylinder(1.5, 8, sections=24), x, y, 1.0)
        for x in (-11, 11)
        for y in (-6, 6)
    ]
    return _cut(trimesh, trimesh.boolean.union([shell, *bosses], engine="manifold"), *drills)


def _chamfered(trimesh, side, edge):
    half = side / 2
    corners = [(half - edge, half, half), (half, half - edge, half), (half, half, half - edge)]
    signs = np.stack(np.meshgrid(*[[-1, 1]] * 3), axis=-1).reshape(-1, 1, 3)
    return trimesh.Trimesh((signs * np.array(corners)).reshape(-1, 3)).convex_hull


def _bellows(trimesh, folds, around):
    """A wave turned about z, open at both ends, its wall 2 mm thick across."""
    z = np.linspace(0, 8.0 * folds, 8 * folds + 1)
    r = 10 - 1.2 * np.cos(2 * np.pi * z / 8)
    outer, inner = np.stack([r + 2.2, z], axis=1), np.stack([r, z], axis=1)[::-1]
    return trimesh.creation.revolve(np.concatenate([inner, outer, inner[:1]]), sections=around)
