"""What acts is drawn where it acts: loads of solids, wrenches and weight of rods."""

import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import fem, material, mesh as M, rod as R, sdf, view
from sorojax.fem.equilibrium.solve import Path
from sorojax.math.lie import SE2, SE3, homogeneous
from sorojax.math.status import Status
from sorojax.reduction.backbone import Backbone
from sorojax.view import style
from sorojax.view.draw.loads import coil, load_parts, support_parts, turning
from sorojax.view.draw.rods import rod_scene, wrench_parts
from sorojax.view.film.tracks import track_of
from sorojax.view.raster.scene import Arrows, Dots, Lines
from tests.test_view_show import is_whole, near, pixels, words

LENGTH = 0.06
RUBBER = material.neo_hookean(young_modulus=1e5, poisson_ratio=0.4, density=1e3)
TORQUE, SPRING, RIGID, WALL = (
    tuple(int(style.COLOURS[k][i : i + 2], 16) for i in (1, 3, 5)) for k in (4, 2, 0, 1)
)


def beam(dim):
    if dim == 2:
        return M.rectangle([0.0, -0.005], [LENGTH, 0.005], divisions=(12, 2), order=2)
    return M.box([0.0, 0.0, 0.0], [LENGTH, 0.02, 0.02], divisions=(6, 2, 2))


def loaded(dim, *loads, supports=None):
    mesh = beam(dim)
    held = supports or (fem.Fixed(M.nodes_where(mesh, lambda p: p[0] < 1e-9)),)
    plane = fem.PlaneStrain(0.02) if dim == 2 else None
    return fem.problem(mesh, RUBBER, kinematics=plane, supports=held, loads=loads)


def tip(dim):
    return M.nodes_where(beam(dim), lambda p: p[0] > LENGTH - 1e-9)


def parts_of(problem):
    return load_parts(problem, np.zeros(problem.mesh.points.shape))


@pytest.mark.parametrize("dim", [2, 3])
def test_torques_springs_and_rigid_parts_are_drawn(dim):
    axis = None if dim == 2 else [0.0, 1.0, 0.0]
    ground = [LENGTH, 0.03] if dim == 2 else [LENGTH, 0.01, 0.05]
    bed = M.nodes_where(
        beam(dim), lambda p: (p[-1] < -0.005 + 1e-9) if dim == 2 else p[-1] < 1e-9
    )
    problem = loaded(
        dim,
        fem.Torque(tip(dim), 2e-3, axis),
        fem.Spring(tip(dim)[:1], ground, 40.0),
        fem.Foundation(bed, 5.0),
        fem.rigid(beam(dim), tip(dim)),
    )
    picture = view.show(problem, **({} if dim == 2 else {"view": "front", "renderer": "own"}))
    assert is_whole(picture)
    for name in ("torque: 0.002 N m", "spring: 40 N/m", "foundation: 5 N/m", "rigid"):
        assert name in words(picture), name
    image = pixels(picture)
    for colour, least in ((TORQUE, 40), (SPRING, 40), (RIGID, 20)):
        assert near(image, colour, 60).sum() > least
    ends = [part for part in parts_of(problem) if isinstance(part, Dots)]
    assert any(np.allclose(part.points, ground) for part in ends)  # the ground of the spring


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_an_arc_turns_as_its_torque(sense):
    """The head of the arc moves around the centre in the sense of the torque."""
    flat = turning(np.zeros(2), sense, 1.0, "#000000")
    solid = turning(np.zeros(3), sense * np.array([0.0, 0.0, 2.0]), 1.0, "#000000")
    for line, head in (flat, solid):
        assert isinstance(line, Lines) and isinstance(head, Arrows)
        arm, along = head.starts[0], head.vectors[0]
        assert np.sign(arm[0] * along[1] - arm[1] * along[0]) == sense
        assert np.allclose(np.linalg.norm(line.runs[0], axis=1), 1.0)
    problem = loaded(2, fem.Torque(tip(2), sense * 2e-3))
    head = next(part for part in parts_of(problem) if isinstance(part, Arrows))
    arm = head.starts[0] - np.array([LENGTH, 0.0])
    assert np.sign(arm[0] * head.vectors[0, 1] - arm[1] * head.vectors[0, 0]) == sense


def test_a_spring_between_nodes_goes_along_with_them():
    mesh = beam(2)
    first, last = M.nearest_node(mesh, [0.02, 0.005]), M.nearest_node(mesh, [0.05, 0.005])
    problem = loaded(2, fem.Spring([first], [last], 40.0))
    moved = 0.1 * np.asarray(mesh.points)
    (line,) = load_parts(problem, moved)
    assert isinstance(line, Lines)
    ends = np.asarray(mesh.points)[[first, last]] * 1.1
    assert np.allclose(line.runs[0][[0, -1]], ends)
    straight = coil(ends[0], ends[1], 0.0)
    assert np.allclose(straight[:, 1], ends[0, 1]) and np.all(np.diff(straight[:, 0]) > 0)


def test_a_cavity_in_a_solid_is_seen_through_it():
    box = M.box([0.0, 0.0, 0.0], [0.06, 0.03, 0.03], divisions=(6, 3, 3))
    centres = np.asarray(box.points)[np.asarray(box.cells)].mean(axis=1)
    hollow = np.all(np.abs(centres - [0.03, 0.015, 0.015]) < [0.02, 0.005, 0.005], axis=1)
    used, cells = np.unique(np.asarray(box.cells)[~hollow], return_inverse=True)
    body = M.Mesh(np.asarray(box.points)[used], cells.reshape(-1, 8), box.element)
    inside = M.facets_where(
        body,
        lambda p: (
            jnp.all(jnp.abs(p - jnp.array([0.03, 0.015, 0.015])) < 0.0139)
            | (jnp.abs(p[0] - 0.03) < 0.021) & (jnp.abs(p[1:] - 0.015).max() < 0.0051)
        ),
    )
    problem = fem.problem(
        body,
        RUBBER,
        supports=(fem.Fixed(M.nodes_where(body, lambda p: p[0] < 1e-9)),),
        loads=(fem.Pressure(inside, 2e4, name="air"),),
    )
    picture = view.show(problem, renderer="own")
    assert "under pressure" in words(picture) and "air: 20 kPa" in words(picture)
    red, green, blue = np.moveaxis(pixels(picture), 2, 0)
    assert np.sum((red > green + 15) & (green >= blue - 5)) > 500  # the wall, seen through
    closed = fem.Solution(
        problem,
        0 * body.points,
        Status.successful,
        None,
        cavities=("air",),
        pressures=jnp.array([2e4]),
        volumes=jnp.array([3e-6]),
    )
    assert "air: 20 kPa" in words(view.show(closed, field=None, renderer="own"))
    assert repr(closed).splitlines()[1] == "  air: 2e+04 Pa in 3e-06 m^3"


def test_moved_supports_are_told_from_held_ones():
    moved = fem.Prescribed(tip(2), [1e-3, 0.0])
    held = fem.Fixed(M.nodes_where(beam(2), lambda p: p[0] < 1e-9))
    problem = loaded(2, supports=(held, moved))
    names = [part.name for part in support_parts(problem, np.zeros(problem.mesh.points.shape))]
    assert names == ["held", "moved"]


def test_volumes_of_a_cavity_name_the_states_of_a_path():
    problem = loaded(2, fem.Pressure(M.boundary_facets(beam(2)), 1e3, name="air"))
    shapes = jnp.stack([0 * beam(2).points, 0.05 * beam(2).points])
    volumes, pressures = jnp.array([1e-5, 2e-5]), jnp.array([1e3, 3e3])
    path = Path(problem, shapes, volumes, "air", Status.successful, (), pressures)
    picture = view.show(path, field=None)
    assert "10 ml at 1 kPa" in words(picture) and "20 ml at 3 kPa" in words(picture)
    assert track_of(path, field=None).unit == "ml"
    assert repr(path).startswith("Path: 2 states, successful")


ROD = {"length": 0.12, "young_modulus": 1e5, "poisson_ratio": 0.49, "density": 1e3}


@pytest.fixture(scope="module")
def arm():
    return R.rod(SE3(), R.chebyshev(kappa_y=2, kappa_z=2), R.circle(0.008), **ROD)


def test_wrenches_of_a_rod_are_arrows_and_arcs(arm):
    forces = (R.TipWrench([0.0, 2e-3, 0.0, 0.0, 0.0, -0.5]), R.Gravity())
    picture = view.show(arm, forces=forces, view="front", renderer="own")
    assert is_whole(picture)
    for name in ("force: 0.5 N", "moment: 0.002 N m", "gravity: 9.81 m/s"):
        assert name in words(picture), name
    image = pixels(picture)
    below = picture.pixels([[0.12, 0.0, -0.016]])[0].astype(int)
    around = image[below[1] - 4 : below[1] + 5, below[0] - 4 : below[0] + 5]
    assert near(around, WALL, 70).any()  # the arrow goes down from the tip
    assert near(image, TORQUE, 60).sum() > 40


def test_a_follower_turns_with_its_section():
    rod = R.rod(SE2(), R.chebyshev(kappa_z=1), R.rectangle(0.01, 0.02), **ROD)
    s = np.linspace(0, 1, 61)
    poses = {"": np.asarray(R.forward_kinematics(rod, jnp.array([np.pi / 2 / 0.12]), s))}
    for follower, along in ((False, [1.0, 0.0]), (True, [0.0, 1.0])):
        push = R.PointWrench([1e-3, 2.0, 0.0], s=1.0, follower=follower)
        arrow, arc, _ = wrench_parts(poses, s, (push,), 0.12)
        assert np.allclose(
            arrow.vectors[0] / np.linalg.norm(arrow.vectors[0]), along, atol=1e-6
        )
        assert np.allclose(arrow.starts[0], poses[""][-1, :2, 2])
        assert isinstance(arc, Lines) and arc.name == "moment: 0.001 N m"
    line = R.LineWrench(lambda s: jnp.stack([0 * s, 0 * s, -3 * s]))
    (arrows,) = wrench_parts(poses, s, (line,), 0.12)
    sizes = np.linalg.norm(arrows.vectors, axis=1)
    assert (
        np.allclose(sizes / sizes[-1], np.linspace(0, 1, 9)) and arrows.name == "force: 3 N/m"
    )


def test_wrenches_find_the_part_that_they_name(arm):
    offset = homogeneous(jnp.eye(3), jnp.array([0.03, 0.0, 0.0]))
    hand = R.assembly(
        SE3(),
        palm=R.Part(R.Link(0.05, [2e-5, 2e-5, 3e-5])),
        finger=R.Part(arm, on="palm", offset=offset),
    )
    wrench = R.PartForce("finger", R.TipWrench([0.0, 0.0, 0.0, 0.0, 0.3, 0.0]))
    scene = rod_scene(hand, forces=(wrench,))
    (arrow,) = [part for part in scene.parts if isinstance(part, Arrows)]
    assert np.allclose(arrow.starts[0], [0.15, 0.0, 0.0]) and arrow.name == "force: 0.3 N"


def test_a_backbone_and_its_largest_change_are_drawn():
    s, bends = jnp.linspace(0.0, 1.0, 21), jnp.array([0.0, 5.0, 15.0])
    kappa = bends[:, None] * s[None]
    strain = jnp.stack([kappa, 1 + 0 * kappa, 0 * kappa], axis=2)
    x = jnp.broadcast_to(LENGTH * s, kappa.shape)
    places = jnp.stack([x, kappa * x**2 / 2], axis=2)
    backbone = Backbone(s, jnp.asarray(LENGTH), places, strain)
    picture = view.show(backbone)
    assert is_whole(picture) and "3 snapshots of a backbone of 60 mm" in words(picture)
    assert "change of kappa_z" in words(picture)
    assert np.allclose(picture.panels[1].axes.lines[-1].get_ydata(), 15 * np.asarray(s))
    assert repr(backbone).startswith("Backbone: 3 snapshots of 21 samples in 2 dimensions")


def test_a_rod_in_a_body_is_a_line_that_goes_along():
    mesh = beam(2)
    line = [[0.005, -0.001], [0.055, 0.002]]
    rod = fem.embedded_rod(mesh, line, axial_stiffness=1.0, name="fibre")
    _, free = fem.bonded_rod(mesh, rod, bond_strength=1.0, tie_stiffness=1.0)
    problem = loaded(2, rod)
    (drawn,) = load_parts(problem, 0.1 * np.asarray(mesh.points))
    assert isinstance(drawn, Lines) and drawn.name == "fibre"
    assert np.allclose(drawn.runs[0][[0, -1]], 1.1 * np.array(line))
    assert free.nodes.shape[0] == len(drawn.runs[0])


def test_arrows_of_a_pressure_are_spread_over_its_chambers():
    holes = [sdf.Rectangle([x, 2e-3], [x + 6e-3, 8e-3]) for x in (2e-3, 12e-3, 22e-3, 32e-3)]
    plate = M.triangulate(
        sdf.Rectangle([0, 0], [40e-3, 10e-3]) - sdf.union(*holes), size=1.5e-3, order=2
    )
    walls = M.facets_on(plate, sdf.union(*holes))
    problem = fem.problem(
        plate,
        RUBBER,
        kinematics=fem.PlaneStrain(0.01),
        supports=(fem.Fixed(M.nodes_where(plate, lambda p: p[0] < 1e-9)),),
        loads=(fem.Pressure(walls, 1e3),),
    )
    (arrows,) = [part for part in parts_of(problem) if isinstance(part, Arrows)]
    count = np.histogram((arrows.starts + arrows.vectors)[:, 0], [0, 0.01, 0.02, 0.03, 0.04])[0]
    assert count.sum() == 24 and count.min() >= 4
