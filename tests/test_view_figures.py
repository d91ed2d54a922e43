"""Solid scenes in figures of one's own: shadows, plane bodies with a depth, skins of rods."""

import importlib.util

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

from sorojax import fem, material, mesh as M, robots, rod as R, sdf, view
from sorojax.math.lie import SE2, SE3, homogeneous
from sorojax.view.raster import raster, solid
from sorojax.view.raster.scene import Arrows, Dots, Lines, Scale, Scene, Surface
from sorojax.view.raster.shadow import in_shadow, lamp_of

FLOOR = Surface(
    np.array([[-4.0, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]]),
    np.array([[0, 1, 2], [0, 2, 3]]),
)
BALL = view.scene_of(sdf.Sphere([0.0, 0.0, 2.0], 0.6)).parts[0]
VIEW = view.Camera(-70.0, 40.0)
SIZE = (160, 120)
_QUARTER = homogeneous(jnp.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), jnp.array([0.1, 0, 0]))


def seen(scene, **options):
    """The picture and the lens of a scene."""
    lens = solid.lens_of([scene], VIEW, SIZE)
    return raster.shade(scene, lens, **options).astype(int), lens


def at(image, lens, point):
    x, y, _ = lens(np.atleast_2d(point))[0]
    return image[int(y), int(x)]


def test_a_ball_throws_its_shadow_where_the_rays_of_the_lamp_say():
    scene = Scene((FLOOR, BALL))
    plain, lens = seen(scene)
    shaded, _ = seen(scene, shadow=in_shadow)
    towards = lamp_of(VIEW).axes[2]
    foot = np.array([0.0, 0.0, 2.0]) - 2.0 / towards[2] * towards
    assert abs(foot[0]) > 0.6 or abs(foot[1]) > 0.6  # beside the ball
    darker = at(shaded, lens, foot).mean() / at(plain, lens, foot).mean()
    assert 0.5 < darker < 0.8  # the other lamp still gets there
    for aside in ([1.0, 0, 0], [-1.0, 0, 0], [0, 1.2, 0], [0, -1.2, 0]):
        assert np.array_equal(at(shaded, lens, foot + aside), at(plain, lens, foot + aside))
    assert np.all(shaded <= plain + 1)  # a shadow never lights


def test_nothing_throws_a_shadow_on_itself_where_light_falls():
    """Where light falls within 53 degrees of the normal the pixels of the map leave no marks;
    beyond, a body gets dark by itself."""
    for part in (FLOOR, BALL):
        lens = solid.lens_of([Scene((part,))], VIEW, SIZE)
        soup = raster.soup_of([(0, part)], lens, 1.0)
        found = raster.rasterise(soup.pixels, *SIZE)
        shade = in_shadow(Scene((part,)), lens, found.depth)
        facing = np.mean(soup.normals, axis=1) @ lamp_of(VIEW).axes[2]
        lit = np.append(facing, -1)[found.triangle.ravel()] > 0.6  # within the bias
        assert lit.sum() > 500 and shade[lit].max() == 0


def test_lines_and_clear_bodies_throw_no_shadow():
    clear = Surface(BALL.points, BALL.triangles, opacity=0.5)
    line = Lines([BALL.points[:50]])
    for parts in ((FLOOR,), (FLOOR, clear), (FLOOR, line)):
        lens = solid.lens_of([Scene((FLOOR,))], VIEW, SIZE)
        depth = raster.rasterise(raster.soup_of([(0, FLOOR)], lens, 1.0).pixels, *SIZE).depth
        assert in_shadow(Scene(parts), lens, depth).max() == 0
    nothing = np.full((4, 5), np.inf)
    assert np.array_equal(in_shadow(Scene((FLOOR,)), lens, nothing), np.zeros(20))


def test_the_lamp_of_the_shadow_is_that_of_the_light():
    for camera in (VIEW, view.Camera(10.0, -30.0), view.Camera(120.0, 5.0)):
        expect = raster.KEY / np.linalg.norm(raster.KEY) @ camera.axes
        assert np.allclose(lamp_of(camera).axes[2], expect, rtol=0, atol=1e-12)


@pytest.mark.skipif(not importlib.util.find_spec("pyvista"), reason="needs the extra `view`")
def test_pyvista_throws_shadows_too():
    scene = Scene((FLOOR, BALL))
    lens = solid.lens_of([scene], VIEW, SIZE)
    look = {"renderer": "pyvista", "shadows": True}
    assert solid.picture_of(scene, lens, **look).shape == (120, 160, 3)


# Plane scenes with a depth


@pytest.fixture(scope="module")
def plate():
    """A plate with a hole, 40 x 20 mm."""
    shape = sdf.Rectangle([0, 0], [0.04, 0.02]) - sdf.Circle([0.02, 0.01], 0.005)
    return M.triangulate(shape, size=0.003, order=2)


def volume(surface: Surface) -> float:
    """Inside a closed surface, by the divergence theorem."""
    a, b, c = (surface.points[surface.triangles[:, k]] for k in range(3))
    return float(np.einsum("ti,ti->", a, np.cross(b, c)) / 6)


def test_a_plane_body_becomes_a_closed_solid_of_its_depth(plate):
    flat = view.scene_of(plate, field=np.asarray(plate.points)[:, 0], label="x [m]")
    block = view.extrude(flat, 0.01)
    (body,) = (part for part in block.parts if isinstance(part, Surface))
    sides = np.concatenate([body.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    keys = sides @ np.array([len(body.points), 1])
    back = sides @ np.array([1, len(body.points)])
    assert len(np.unique(keys)) == len(keys)  # each side once this way and once the other
    assert np.array_equal(np.sort(keys), np.sort(back))
    area = volume(body) / 0.01
    assert area == pytest.approx(0.04 * 0.02 - np.pi * 0.005**2, rel=2e-3)
    assert np.allclose(body.values, body.points[:, 0])  # the field goes through the depth
    lower, upper = block.box
    assert np.allclose(upper - lower, [0.04, 0.01, 0.02], rtol=0, atol=1e-9)
    assert block.scale is not None and block.scale == flat.scale


def test_values_colours_and_sides_of_triangles_go_with_them(plate):
    flat = view.scene_of(plate).parts[0]
    assert isinstance(flat, Surface) and flat.wire is not None
    number = np.arange(float(len(flat.triangles)))
    rows = np.stack([number, number, number], axis=1)
    for part in (Surface(flat.points, flat.triangles, values=number),
                 Surface(flat.points, flat.triangles, rows, wire=flat.wire)):  # fmt: skip
        block = view.extrude(Scene((part,)), 0.01).parts[0]
        found = block.values if part.values is not None else np.asarray(block.colour)[:, 0]
        owner = np.asarray(found).astype(int)
        corners = np.asarray(flat.points)[flat.triangles[owner]]
        here = block.points[block.triangles][:, :, [0, 2]]
        gap = np.linalg.norm(here[:, :, None] - corners[:, None], axis=3).min(axis=2)
        assert gap.max() < 1e-12  # every corner is one of the triangle that owns the face
        if part.wire is not None:
            assert len(block.sides) == 2 * len(part.sides)


def test_lines_arrows_and_dots_find_their_place():
    run, spot = np.array([[0.0, 0.0], [1.0, 2.0]]), np.array([[1.0, 2.0]])
    parts = (Lines([run], "red"), Arrows(spot, spot), Dots(spot))
    extent = (np.zeros(2), np.array([1.0, 2.0]))
    made = view.extrude(Scene(parts, extent=extent), 0.5)
    lines, arrows, dots = made.parts
    assert [r[:, 1].tolist() for r in lines.runs] == [[-0.25] * 2, [0.25] * 2]
    assert np.array_equal(lines.runs[0][:, [0, 2]], run) and lines.colour == "red"
    assert np.array_equal(arrows.vectors, [[1, 0, 2]]) and np.array_equal(
        dots.points, [[1, 0, 2]]
    )
    assert np.array_equal(made.box[0], [0, -0.25, 0])
    assert np.array_equal(made.box[1], [1, 0.25, 2])


def test_a_solid_scene_and_a_depth_of_zero_are_refused(plate):
    with pytest.raises(ValueError, match="view.extrude: the scene is solid already"):
        view.extrude(Scene((BALL,)), 0.01)
    with pytest.raises(ValueError, match="view.extrude: `depth`"):
        view.extrude(view.scene_of(plate), 0.0)


def test_all_parts_of_a_scene_go_with_a_pose():
    spot = np.array([[1.0, 2.0, 3.0]])
    parts = (BALL, Lines([spot, 2 * spot]), Arrows(spot, spot), Dots(spot))
    ball, lines, arrows, dots = view.place(Scene(parts), _QUARTER, "red").parts
    turned = np.array([[-2.0, 1.0, 3.0]])
    assert np.allclose(dots.points, turned + [0.1, 0, 0], rtol=0, atol=1e-12)
    assert np.allclose(lines.runs[1], 2 * turned + [0.1, 0, 0], rtol=0, atol=1e-12)
    assert np.allclose(arrows.starts, dots.points, rtol=0, atol=1e-12)
    assert np.allclose(arrows.vectors, turned, rtol=0, atol=1e-12)  # not shifted
    assert volume(ball) == pytest.approx(volume(BALL), rel=1e-9)
    assert {part.colour for part in (ball, lines, arrows, dots)} == {"red"}
    assert view.place(Scene((BALL,)), np.eye(4)).parts[0].colour == BALL.colour
    with pytest.raises(ValueError, match="view.place: got .* for `pose`"):
        view.place(Scene((BALL,)), np.eye(3))
    with pytest.raises(ValueError, match="view.place: the scene is plane"):
        view.place(Scene((Dots(np.zeros((1, 2))),)), np.eye(4))


# Scenes of a path, in figures


def test_states_of_a_path_share_box_and_scale():
    cells = M.rectangle([0, 0], [0.04, 0.01], divisions=(4, 1), element=M.Quad9())
    wall = fem.Fixed(M.nodes_where(cells, lambda p: p[0] < 1e-9))
    pull = fem.Gravity([0.0, -1.0], name="pull")
    body = fem.problem(
        cells, material.presets.dragon_skin_30(), kinematics=fem.PlaneStrain(0.01),
        supports=(wall,), loads=(pull,),
    )  # fmt: skip
    path = fem.solve_path(body, pull=jnp.array([[0.0, -1.0], [0.0, -4.0]]))
    first, last = view.scenes_of(path, np.array([0, 1]), field="displacement")
    assert first.scale is last.scale and first.box is last.box
    tip = np.linalg.norm(np.asarray(path.displacements), axis=2).max(axis=1)
    values = [
        max(p.values.max() for p in s.parts if isinstance(p, Surface)) for s in (first, last)
    ]
    assert first.scale is not None and first.scale.label == "displacement [um]"
    assert values == pytest.approx(1e6 * tip, rel=1e-9)
    with pytest.raises(ValueError, match="view.scenes_of: `states` is \\[2\\]"):
        view.scenes_of(path, [2])


def figure_of(count):
    figure = Figure(figsize=(4, 2), dpi=100, layout="constrained")
    return figure, [figure.add_subplot(1, count, k + 1) for k in range(count)]


def test_scenes_are_drawn_on_one_scale_with_a_bar_of_known_length():
    small = view.scene_of(sdf.Sphere([0.0, 0.0, 0.0], 0.01))
    large = view.scene_of(sdf.Sphere([0.0, 0.0, 0.0], 0.02))
    figure, axes = figure_of(2)
    view.draw_into(axes, [small, large], view=view.Camera(0.0, 0.0, opening=0.0))
    wide = []
    for each in axes:
        (image,) = each.get_images()
        inside = np.any(np.asarray(image.get_array()).min(axis=2) < 250, axis=0)
        wide.append(inside.sum())
    assert wide[1] == pytest.approx(2 * wide[0], abs=2)
    (bar,) = axes[0].get_lines()
    (text,) = axes[0].texts
    told = float(text.get_text().removesuffix(" mm"))
    assert np.ptp(bar.get_xdata()) / wide[1] == pytest.approx(told / 40, rel=0.03)
    assert not axes[1].get_lines()
    before = [each.get_window_extent().bounds for each in axes]
    figure.draw_without_rendering()
    assert before == [each.get_window_extent().bounds for each in axes]  # the layout stays


def test_a_scale_of_values_gets_a_colour_bar_beside_all():
    valued = Surface(BALL.points, BALL.triangles, values=BALL.points[:, 2])
    scene = Scene((valued,), Scale("height [m]", 1.0, 3.0))
    for bar, count in ((True, 2), (False, 1)):
        figure, (axes,) = figure_of(1)
        view.draw_into(axes, scene, bar=bar, scale=False, shadows=False)
        assert len(figure.axes) == count
        if bar:
            assert figure.axes[1].get_ylabel() == "height [m]"


def test_axes_and_scenes_that_do_not_fit_are_refused(plate):
    _, axes = figure_of(2)
    with pytest.raises(ValueError, match="got 2 axes for 1 scenes"):
        view.draw_into(axes, Scene((BALL,)))
    with pytest.raises(ValueError, match="got a plane scene"):
        view.draw_into(axes[0], view.scene_of(plate))


# Rods in the skin of what is printed


def bar(length):
    basis = R.chebyshev(kappa_y=2, kappa_z=2)
    return R.rod(
        SE3(), basis, R.circle(0.002), length=length, nodes=8,
        young_modulus=1e5, poisson_ratio=0.49, density=1e3,
    )  # fmt: skip


def test_a_rod_carries_its_shape_as_a_rig_would():
    rod = bar(0.05)
    skin = sdf.isosurface(sdf.Capsule([0, 0, 0], [0.05, 0, 0], 0.004), 0.002)
    q = jnp.array([6.0, 3.0, 15.0, -4.0])
    (drawn,) = view.scene_of(rod, q, shapes={"rod": skin}, colours={"rod": "#112233"}).parts
    expect = view.pose(view.rig(rod, skin, stations=61), q)
    assert np.allclose(drawn.points, expect, rtol=0, atol=1e-12)
    assert drawn.colour == "#112233"


def test_parts_carry_their_shapes_where_they_stand():
    turn = np.asarray(_QUARTER)
    ball = R.Part(robots.cylinder(0.1, 0.01, 0.01))
    finger = R.Part(bar(0.05), offset=turn)
    model = R.assembly(SE3(), ball=ball, finger=finger)
    capsule = sdf.Capsule([0, 0, 0], [0.05, 0, 0], 0.004)
    shapes = {"ball": sdf.Sphere([0, 0, 0], 0.01), "finger": capsule}
    held, drawn = view.scene_of(model, shapes=shapes, colours={"ball": "#445566"}).parts
    own = view.scene_of(capsule).parts[0].points
    assert np.allclose(drawn.points, own @ turn[:3, :3].T + turn[:3, 3], rtol=0, atol=1e-12)
    assert held.colour == "#445566" and drawn.colour != held.colour


def test_a_planar_rod_takes_no_shape():
    rod = R.rod(
        SE2(), R.chebyshev(kappa_z=1), R.circle(0.002), length=0.05,
        young_modulus=1e5, poisson_ratio=0.49, density=1e3,
    )  # fmt: skip
    with pytest.raises(ValueError, match="got a shape for a planar rod"):
        view.scene_of(rod, shapes={"rod": sdf.Sphere([0, 0, 0], 0.01)})


def test_a_printed_finger_lies_along_x_and_bends_towards_its_spine():
    finger = robots.Finger()
    lower, upper = (np.asarray(corner) for corner in finger.along_x().bounding_box())
    fillet = 1e-3  # the box allows for the rounding between folds and tube
    assert lower[0] == pytest.approx(0, abs=fillet)
    assert upper[0] == pytest.approx(float(finger.length), abs=fillet)
    spine = float(finger.bellows.outer_radius + finger.spine_thickness / 3)
    half = float(finger.length) / 2
    inside = finger.along_x()(jnp.array([[half, spine - 1e-4, 0.0], [half, 1e-4 - spine, 0.0]]))
    assert inside[0] < 0 < inside[1]
