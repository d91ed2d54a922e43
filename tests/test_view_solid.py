"""The own renderer: which triangle a pixel sees, where points land, what light leaves of
colours."""

import importlib.util
import os
import subprocess
import sys

import numpy as np
import pytest

from sorojax.view import Camera, between, orbit
from sorojax.view.raster import glyphs, raster as S, solid
from sorojax.view.raster.camera import box_corners, camera_at, fit
from sorojax.view.raster.raster import barycentric, rasterise
from sorojax.view.raster.scene import Arrows, Dots, Lines, Scale, Scene, Surface

PRESETS = ("iso", "front", "back", "left", "right", "top", "bottom")
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
TWO = np.array([[0, 1, 2], [0, 2, 3]])


def brute_force(corners, width, height):
    """Nearest triangle of every pixel centre, one triangle at a time."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    nearest, found = np.full((height, width), np.inf), np.full((height, width), -1)
    for k, ((ax, ay, az), (bx, by, bz), (cx, cy, cz)) in enumerate(corners):
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        b = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area
        c = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
        depth = az + b * (bz - az) + c * (cz - az)
        inside = (b >= 0) & (c >= 0) & (b + c <= 1) & (depth < nearest)
        nearest[inside], found[inside] = depth[inside], k
    return found, nearest


def test_every_pixel_sees_the_nearest_triangle():
    rng = np.random.default_rng(3)
    corners = rng.uniform(-10, 60, (60, 3, 3))  # some reach out of the picture
    seen = rasterise(corners, 50, 40)
    found, depth = brute_force(corners, 50, 40)
    assert np.array_equal(seen.triangle, found)
    assert np.allclose(seen.depth[found >= 0], depth[found >= 0], rtol=0, atol=1e-6)
    assert np.all(np.isinf(seen.depth[found < 0]))


def test_neighbours_leave_no_gap_and_slivers_no_mark():
    x, y = np.meshgrid(np.linspace(3.0, 47.0, 8), np.linspace(2.6, 37.4, 6))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    a = (np.arange(7)[None] + 8 * np.arange(5)[:, None]).ravel()
    cells = np.concatenate([np.stack([a, a + 1, a + 9], 1), np.stack([a, a + 9, a + 8], 1)])
    seen = rasterise(points[cells], 50, 40).triangle >= 0
    assert seen[3:37, 3:47].all() and seen.sum() == 34 * 44
    line = np.array([[[1.0, 1, 0], [40, 30, 0], [1, 1, 0]]])
    assert not np.any(rasterise(line, 50, 40).triangle >= 0)
    assert not np.any(rasterise(np.zeros((0, 3, 3)), 50, 40).triangle >= 0)


def test_shares_of_corners_give_back_the_pixel():
    corners = np.random.default_rng(1).uniform(0, 40, (5, 3, 3))
    triangle, column, row = np.arange(5), np.arange(5) + 3, np.arange(5) + 7
    shares = np.stack(barycentric(corners, triangle, column, row), axis=1)
    back = np.einsum("pc,pci->pi", shares, corners[:, :, :2])
    assert np.allclose(back, np.stack([column + 0.5, row + 0.5], 1), rtol=0, atol=1e-3)


@pytest.mark.parametrize("view", PRESETS)
@pytest.mark.parametrize("opening", [0.0, 24.0, 90.0])
def test_all_of_the_scene_is_in_the_picture(view, opening):
    preset = camera_at(view)
    camera = Camera(preset.azimuth, preset.elevation, opening=opening)
    points = box_corners(np.array([1.0, 2, 3]), np.array([1.5, 2.1, 3.4]))
    lens = fit(camera, points, (300, 200), margin=0.05)
    at = lens(points)
    low, high = at[:, :2].min(axis=0), at[:, :2].max(axis=0)
    assert np.all(low >= [15 - 1e-9, 10 - 1e-9]) and np.all(high <= [285 + 1e-9, 190 + 1e-9])
    assert np.any(np.isclose(high - low, [270, 180]))  # and fills it
    nearest = points[np.argmin(at[:, 2])]
    assert np.isclose(camera.axes[2] @ nearest, (points @ camera.axes[2]).max())


def test_views_and_paths():
    assert np.allclose(Camera(-90, 0).axes, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-15)
    assert orbit("front", turns=0.5)(1.0).azimuth == 90.0
    path = between("front", Camera(0.0, 40.0, zoom=2.0))
    assert (path(0.0).elevation, path(1.0).zoom, path(0.5).azimuth) == (0.0, 2.0, -45.0)
    with pytest.raises(ValueError, match="need one of iso, front"):
        camera_at("above")
    with pytest.raises(ValueError, match="positive zoom"):
        Camera(zoom=0.0)


def test_triangles_without_a_place_leave_the_others_as_they_are():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
    known = Surface(
        square, np.array([[0, 1, 2]]), values=np.array([0.2]), wire=np.ones((1, 3), bool)
    )
    torn = Surface(
        np.concatenate([square, [[np.nan, 0, 0]]]),
        np.array([[0, 4, 3], [0, 1, 2]]),
        values=np.array([0.9, 0.2]),
        wire=np.ones((2, 3), bool),
    )
    scale, box = Scale("share [-]", 0.0, 1.0), (np.zeros(3), np.ones(3))
    shown = [picture(Scene((part,), scale, extent=box))[0] for part in (known, torn)]
    assert np.array_equal(*shown) and shown[0].min() < 200


def picture(scene, view="front", size=(80, 80), **options):
    lens = solid.lens_of([scene], view, size)
    return S.shade(scene, lens, **options), lens


def at_point(image, lens, point):
    x, y, _ = lens(np.atleast_2d(point))[0]
    return image[int(y), int(x)].astype(int)


def test_colours_are_those_of_the_values_in_perspective():
    """A floor that runs away from the eye: colours at projected points, not in the plane
    of the picture."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 8, 0], [0, 8, 0]])
    scale = Scale("y", 0.0, 8.0)
    scene = Scene((Surface(points, TWO, values=points[:, 1]),), scale)
    image, lens = picture(scene, Camera(-90, 35, opening=70), size=(200, 200), samples=1)
    table = scale.table() / np.linalg.norm(scale.table(), axis=1)[:, None]
    for y in (1.0, 4.0, 7.0):
        colour = at_point(image, lens, [0.5, y, 0.0]).astype(float)
        nearest = np.argmax(table @ (colour / np.linalg.norm(colour)))
        assert abs(nearest - 32 * y) < 14, (y, nearest)


def test_what_is_in_front_hides_what_is_behind():
    front = Surface(SQUARE, TWO, "#ff0000")
    behind = Surface(SQUARE * [0.5, 1, 0.5] + [0.25, 0.5, 0.25], TWO, "#0000ff")
    image, lens = picture(Scene((behind, front)))
    red = at_point(image, lens, [0.5, 0, 0.5])
    assert red[0] > 150 and red[2] < 80
    back, lens = picture(Scene((behind, front)), "back")
    blue = at_point(back, lens, [0.5, 0.5, 0.5])
    assert blue[2] > 150 and blue[0] < 80
    clear = Surface(SQUARE, TWO, "#ff0000", opacity=0.5)
    image, lens = picture(Scene((behind, clear)))
    mixed = at_point(image, lens, [0.5, 0, 0.5])
    assert mixed[0] > 90 and mixed[2] > 60  # both


def test_values_that_are_not_finite_are_left_plain_and_points_left_out():
    values = np.array([np.nan, 1.0])
    scene = Scene((Surface(SQUARE, TWO, "#00ff00", values),), Scale("v", 0.0, 1.0))
    image, lens = picture(scene)
    plain, coloured = (at_point(image, lens, p) for p in ([0.8, 0, 0.2], [0.2, 0, 0.8]))
    assert plain[1] > 150 and plain[0] < 80 and coloured[0] > 150  # green; yellow
    broken = SQUARE.copy()
    broken[3] = np.nan
    image, lens = picture(Scene((Surface(broken, TWO),)))
    assert 0.2 < np.mean(np.any(image < 250, axis=2)) < 0.6
    with pytest.raises(ValueError, match="every point is NaN"):
        _ = Scene((Surface(np.full((3, 3), np.nan), TWO[:1]),)).box


def test_lines_arrows_and_dots_are_seen_before_what_they_lie_on():
    wall = Surface(SQUARE, TWO, "#ffffff")
    line = Lines([np.array([[0.1, 0, 0.8], [0.9, 0, 0.8]])], "#0000ff", 3.0)
    dashed = Lines([np.array([[0.1, 0, 0.6], [0.9, 0, 0.6]])], "#0000ff", 3.0, dashed=True)
    arrow = Arrows(np.array([[0.1, 0, 0.3]]), np.array([[0.8, 0, 0.0]]), "#ff0000")
    dot = Dots(np.array([[0.5, 0, 0.1]]), "#00ff00", 8.0)
    image, lens = picture(Scene((wall, line, dashed, arrow, dot)), size=(160, 160))
    assert at_point(image, lens, [0.5, 0, 0.8])[0] < 60
    assert at_point(image, lens, [0.85, 0, 0.3])[1] < 120  # the head is thick
    red, green, _ = at_point(image, lens, [0.5, 0, 0.1])
    assert green > 100 > red
    row = int(lens(np.array([[0.5, 0, 0.6]]))[0, 1])
    ink = (image[row, :, 0] < 120).astype(int)
    assert np.sum(np.diff(ink) == 1) >= 3  # more than one dash
    before = Lines([line.runs[0] - [0, 0.1, 0]], "#0000ff", 3.0)
    hidden, lens = picture(Scene((wall, before)), "back", size=(160, 160))
    assert not np.any(hidden[:, :, 2].astype(int) - hidden[:, :, 0] > 60)


def test_cells_are_outlined():
    wire = np.array([[True, True, False], [False, True, True]])
    image, lens = picture(Scene((Surface(SQUARE, TWO, "#ffffff", wire=wire),)), size=(200, 200))
    assert at_point(image, lens, [0.5, 0, 0.5]).min() > 200  # the diagonal is no side
    bare, _ = picture(Scene((Surface(SQUARE, TWO, "#ffffff"),)), size=(200, 200))
    assert image.sum() < bare.sum()


@pytest.mark.parametrize("opacity", [1.0, 0.5])
def test_light_by_pixel_is_as_good_as_light_by_sample(opacity, monkeypatch):
    ball = glyphs.ball_triangles(np.array([[0.5, 0.2, 0.5]]), 0.4, corners=32)
    wire = np.array([[True, True, False], [False, True, True]])
    line = Lines([np.array([[0.0, -0.2, 0.1], [1.0, -0.2, 0.8]])], "#0000ff", 1.0)
    scene = Scene(
        (
            Surface(SQUARE, TWO, values=SQUARE[:, 0], wire=wire),
            Surface(*ball, "#c08060", opacity=opacity),
            line,
        ),
        Scale("x", 0.0, 1.0),
    )
    lit = []
    true = S._lit_colours
    monkeypatch.setattr(S, "_lit_colours", lambda *a: lit.append(len(a[1])) or true(*a))
    quick, _ = picture(scene, "iso", (160, 160))
    assert sum(lit) < 0.7 * 4 * 160**2
    monkeypatch.setattr(S, "_rough", lambda *_: np.ones((160, 160), bool))
    whole, _ = picture(scene, "iso", (160, 160))
    assert np.abs(quick.astype(int) - whole).max() <= 2


def test_normals_are_smooth_but_across_edges():
    points, triangles = glyphs.ball_triangles(np.zeros((1, 3)), 1.0, corners=24)
    normals = S.corner_normals(points, triangles)
    out = np.einsum("nci,nci->nc", normals, points[triangles])
    area = np.linalg.norm(
        np.cross(*(points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2))), axis=1
    )
    assert out[area > 1e-12].min() > 0.98
    square = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    centres = np.array([[0.0, 0, 0], [3, 0, 0]])
    across = np.broadcast_to(np.eye(3)[1:], (2, 2, 3))
    bar = glyphs.tube(centres, across, np.broadcast_to(square, (2, 4, 2)))
    flat = S.corner_normals(*bar)
    assert np.allclose(np.abs(flat).max(axis=2), 1.0)  # each along one axis


@pytest.mark.parametrize("hole", [False, True])
def test_a_tube_is_closed_and_faces_out(hole):
    angle = 2 * np.pi * np.arange(40) / 40
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    centres = np.stack([np.linspace(0, 2, 5), 0 * np.arange(5), 0 * np.arange(5)], axis=1)
    across = np.broadcast_to(np.eye(3)[1:], (5, 2, 3))
    outer = np.broadcast_to(ring, (5, 40, 2))
    points, triangles = glyphs.tube(centres, across, outer, inner=0.5 * outer if hole else None)
    ends = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    assert np.array_equal(np.unique(ends, axis=0), np.unique(ends[:, ::-1], axis=0))
    a, b, c = (points[triangles[:, k]] for k in range(3))
    volume = np.sum(a * np.cross(b, c)) / 6
    disc = 20 * np.sin(2 * np.pi / 40)
    assert np.isclose(volume, 2 * disc * (0.75 if hole else 1.0), rtol=1e-12)


def test_without_pyvista_one_warning_is_given(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(solid, "_warned", False)
    with pytest.warns(UserWarning, match="pyvista is not installed"):
        assert solid.chosen_renderer("auto") == "own"
    assert solid.chosen_renderer("auto") == "own"  # and no second one
    with pytest.raises(ValueError, match="pip install"):
        solid.chosen_renderer("pyvista")
    with pytest.raises(ValueError, match='need "auto"'):
        solid.chosen_renderer("povray")


def test_both_renderers_see_the_same():
    pytest.importorskip("pyvista", reason="the extra `view` is not installed")
    from sorojax.view.raster.solid import screenshot

    points, triangles = glyphs.ball_triangles(np.array([[0.0, 0, 0], [3, 1, 0]]), 1.0, 24)
    scene = Scene((Surface(points, triangles), Lines([np.array([[-1.0, 0, 2], [4, 0, 2]])])))
    for camera in (Camera(), Camera(opening=0.0), Camera(30, 60, opening=60)):
        lens = solid.lens_of([scene], camera, (160, 120))
        masks = [
            np.any(image < 235, axis=2)
            for image in (S.shade(scene, lens), screenshot(scene, lens, 1.4))
        ]
        assert np.mean(masks[0] != masks[1]) < 0.02 * np.mean(masks[0]) + 0.005


def test_a_machine_without_a_display_is_not_told_so():
    pytest.importorskip("pyvista", reason="the extra `view` is not installed")
    draw = (
        "from sorojax import mesh, view\n"
        "print(len(view.show(mesh.box([0, 0, 0], [1, 1, 1], divisions=(1, 1, 1))).png) > 1000)"
    )
    without = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
    done = subprocess.run(
        [sys.executable, "-c", draw], env=without, capture_output=True, text=True
    )
    assert done.returncode == 0 and "True" in done.stdout
    assert "DISPLAY" not in done.stderr
