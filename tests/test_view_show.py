"""`show`: every noun is drawn, off-screen, whole, with the colours and names it should have."""

import importlib
import io
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import contact, fem, material, mesh as M, rod as R, sdf, systems, view
from sorojax.design.optimise.minimise import Optimised
from sorojax.fem.equilibrium.solve import Path
from sorojax.fem.stability.modal import Modes
from sorojax.math.lie import SE2, SE3, homogeneous
from sorojax.math.status import Status
from sorojax.view.draw import networks, rod_loads as sections
from sorojax.view.draw.meshes import outline, shell
from sorojax.view.draw.rod_loads import acting
from sorojax.view.raster.scene import short

LENGTH = 0.06
LOAD, OBSTACLE = (213, 94, 0), (185, 168, 136)
ROD = {"length": 0.12, "young_modulus": 1e5, "poisson_ratio": 0.49, "density": 1e3}


def pixels(picture):
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(picture.png)).convert("RGB")).astype(int)


def is_whole(picture, least=0.02):
    """Something is drawn, and nothing touches the border, so nothing is cut off."""
    image = pixels(picture)
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    return np.mean(np.any(image < 250, axis=2)) > least and bool(np.all(border > 245))


def near(image, colour, tol=40):
    return np.all(np.abs(image - np.array(colour)) <= tol, axis=2)


def patch(picture, image, points, panel=0):
    """Pixels around a point."""
    x, y = picture.pixels(points, panel)[0].astype(int)
    return image[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]


def words(picture):
    """All text in the figure."""
    from matplotlib.text import Text

    return " ".join(text.get_text() for text in picture.figure.findobj(Text))


@pytest.fixture(scope="module", autouse=True)
def _own_renderer():
    """The same pictures with and without the extra, and no warning."""
    from sorojax.view.raster import solid

    before, solid._warned = solid._warned, True
    yield
    solid._warned = before


@pytest.fixture(scope="module")
def beam():
    return M.rectangle([0.0, -0.005], [LENGTH, 0.005], divisions=(12, 2), order=2)


@pytest.fixture(scope="module")
def block():
    return M.box([0.0, 0.0, 0.0], [LENGTH, 0.02, 0.02], divisions=(6, 2, 2))


def problem_of(mesh):
    dim, top = mesh.element.dim, {2: 0.005, 3: 0.02}[mesh.element.dim]
    tip = M.facets_where(mesh, lambda p: jnp.abs(p[0] - LENGTH) < 1e-9)
    roof = M.facets_where(mesh, lambda p: jnp.abs(p[-1] - top) < 1e-9)
    pull = jnp.zeros(dim).at[-1].set(-300.0)
    place = [0.03, 0.0] if dim == 2 else [0.03, 0.01, -0.02]
    return fem.problem(
        mesh,
        material.neo_hookean(young_modulus=1e5, poisson_ratio=0.4, density=1e3),
        kinematics=fem.PlaneStrain(0.02) if dim == 2 else None,
        supports=(fem.Fixed(M.nodes_where(mesh, lambda p: p[0] < 1e-9)),),
        loads=(
            fem.Traction(tip, pull, name="pull"),
            fem.Gravity(0.03 * pull),
            fem.Tendon(
                fem.route(mesh, [[0.01, *[0.001] * (dim - 1)], [0.05, *[0.001] * (dim - 1)]]),
                2.0,
            ),
            fem.Contact(
                roof, sdf.Circle([0.03, 0.012], 0.004) if dim == 2 else sdf.Sphere(place, 0.015)
            ),
        ),
    )


@pytest.fixture(scope="module")
def plane(beam):
    return problem_of(beam)


@pytest.fixture(scope="module")
def solid(block):
    return problem_of(block)


def bent(mesh, share):
    """A displacement that grows along x, across by `share` of the length."""
    points = np.asarray(mesh.points)
    u = np.zeros_like(points)
    u[:, -1] = -share * LENGTH * (points[:, 0] / LENGTH) ** 2
    return jnp.asarray(u)


def solution(problem, share=0.3):
    return fem.Solution(problem, bent(problem.mesh, share), Status.successful, None)


CUBE = sdf.Box([-0.03, -0.02, -0.02], [0.03, 0.02, 0.02]) - sdf.Sphere(
    [0.03, -0.02, 0.02], 0.02
)
RING = sdf.Circle([0.0, 0.0], 0.02) - sdf.Circle([0.0, 0.0], 0.008)


def test_a_solid_shape_is_shaded_with_its_hollow():
    picture = view.show(CUBE, size=0.002, title="cube", renderer="own")
    assert is_whole(picture, 0.2) and "cube" in words(picture) and "mm" in words(picture)
    image = pixels(picture)
    front, side = picture.pixels([[-0.02, -0.02, -0.01], [0.03, 0.015, -0.015]]).astype(int)
    lights = [image[y, x].sum() for x, y in (front, side)]
    assert lights[0] > lights[1] + 20  # two faces, two shades
    with pytest.raises(ValueError, match="unbounded"):
        view.show(sdf.HalfSpace([0.0, 0, 0], [0.0, 0, 1]))


def test_a_slice_shows_the_distance_across_a_solid():
    picture = view.show(CUBE, slice={"z": 0.01}, resolution=60)
    image = pixels(picture)
    inside, outside = picture.pixels([[-0.015, 0.0], [0.032, -0.022]]).astype(int)
    assert image[inside[1], inside[0], 2] > image[inside[1], inside[0], 0] + 60  # blue
    assert image[outside[1], outside[0], 0] > image[outside[1], outside[0], 2] + 60  # red
    assert "y [mm]" in words(picture) and "z = 10 mm" in words(picture)
    with pytest.raises(ValueError, match="one axis"):
        view.show(CUBE, slice={"w": 0.0})


def test_plane_shapes_with_and_without_their_distance():
    assert is_whole(view.show(RING, resolution=60)) and "distance" in words(view.show(RING))
    filled = view.show(RING, filled=True)
    image = pixels(filled)
    rim, hole = filled.pixels([[0.014, 0.0], [0.0, 0.0]]).astype(int)
    assert np.all(np.abs(image[rim[1], rim[0]] - [201, 211, 223]) < 8)
    assert image[hole[1] + 9, hole[0] + 9].min() > 225  # paper or a line of the grid


@pytest.mark.parametrize("kind", ["Tri3", "Tri6", "Tri7", "Quad4", "Quad8", "Quad9", "Poly"])
def test_triangles_cover_the_cells_of_a_plane_mesh(kind):
    if kind == "Poly":
        mesh = M.polymesher(sdf.Rectangle([0, 0], [2, 1]), 12, key=jax.random.key(0))
    elif kind.startswith("Tri"):
        mesh = M.rectangle([0, 0], [2, 1], divisions=(3, 2), order=1 if kind == "Tri3" else 2)
        mesh = M.enrich(mesh) if kind == "Tri7" else mesh
    else:
        mesh = M.rectangle(
            [0, 0],
            [2, 1],
            divisions=(3, 2),
            element={"Quad4": M.Quad4, "Quad8": M.Quad8, "Quad9": M.Quad9}[kind](),
        )
    seen, points = shell(mesh), np.asarray(mesh.points)
    a, b, c = (points[seen.triangles[:, k]] for k in range(3))
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert area.min() > 0
    per_cell = np.bincount(seen.cells, area, minlength=mesh.num_cells)
    assert np.allclose(per_cell, M.cell_areas(mesh), rtol=1e-12)
    # every side of a cell is drawn: their length is that of the boundary once, inside twice
    sides = np.concatenate(
        [seen.triangles[seen.wire[:, k]][:, [k, (k + 1) % 3]] for k in range(3)]
    )
    length = np.linalg.norm(points[sides[:, 0]] - points[sides[:, 1]], axis=1).sum()
    rim = outline(mesh)
    around = np.linalg.norm(points[rim[:, 0]] - points[rim[:, 1]], axis=1).sum()
    assert np.isclose(around, 6.0, rtol=1e-9)
    distinct = np.unique(np.sort(sides, axis=1), axis=0)
    once = np.linalg.norm(points[distinct[:, 0]] - points[distinct[:, 1]], axis=1).sum()
    assert np.isclose(length, 2 * once - around, rtol=1e-9)
    assert is_whole(view.show(mesh, by="quality"))


@pytest.mark.parametrize("element", ["Tet4", "Tet10", "Tet15", "Hex8"])
def test_the_shell_of_a_solid_mesh_faces_out(element):
    if element == "Hex8":
        mesh = M.box([0, 0, 0], [1, 1, 1], divisions=(2, 1, 1))
    else:
        mesh = M.box(
            [0, 0, 0],
            [1, 1, 1],
            divisions=(2, 1, 1),
            element=M.Tet10() if element != "Tet4" else M.Tet4(),
        )
        mesh = M.enrich(mesh) if element == "Tet15" else mesh
    assert mesh.element.name == element
    seen, points = shell(mesh), np.asarray(mesh.points)
    a, b, c = (points[seen.triangles[:, k]] for k in range(3))
    assert np.isclose(np.sum(a * np.cross(b, c)) / 6, 1.0)
    ends = points[outline(mesh)]
    assert np.isclose(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).sum(), 12.0)
    assert seen.cells.max() < mesh.num_cells and len(seen.facets) == len(seen.triangles)


@pytest.mark.parametrize("by", ["quality", "region", "facets", "nodes"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_mesh_tells_its_sets(by, dim, beam, block):
    mesh = beam if dim == 2 else block
    right = M.cells_where(mesh, lambda p: p[0] > LENGTH / 2)
    mesh = M.Mesh(
        mesh.points,
        mesh.cells,
        mesh.element,
        mesh.node_sets,
        mesh.facet_sets,
        {"front half": right},
    )
    picture = view.show(mesh, by=by, renderer="own") if dim == 3 else view.show(mesh, by=by)
    assert is_whole(picture)
    names = {"quality": "best", "region": "front half", "facets": "left", "nodes": "left"}
    assert names[by] in words(picture)
    if by == "region":
        image = pixels(picture)
        half, rest = (
            p.astype(int)
            for p in picture.pixels(
                [
                    [0.046, *([0.0013] if dim == 2 else [0.0, 0.013])],
                    [0.016, *([0.0013] if dim == 2 else [0.0, 0.013])],
                ]
            )
        )
        blue = image[half[1], half[0]]
        assert blue[2] - blue[0] > 40 > abs(np.ptp(image[rest[1], rest[0]]))


def test_what_does_not_fit_a_mesh_is_named(beam):
    with pytest.raises(ValueError, match='need "quality"'):
        view.show(beam, by="size")
    with pytest.raises(ValueError, match="one value per node"):
        view.show(beam, field=np.zeros(3))


@pytest.mark.parametrize("dim", [2, 3])
def test_a_problem_shows_what_holds_and_loads_it(dim, plane, solid):
    problem = plane if dim == 2 else solid
    picture = view.show(problem, **({} if dim == 2 else {"view": "front"}))
    assert is_whole(picture)
    for name in ("held", "pull: 300 Pa", "gravity: 9 m/s", "tendon: 2 N", "obstacle"):
        assert name in words(picture), name
    image = pixels(picture)
    assert near(image, LOAD).sum() > 50 and near(image, OBSTACLE, 60).sum() > 200


@pytest.mark.parametrize("dim", [2, 3])
def test_a_solution_is_coloured_where_it_is(dim, plane, solid):
    """The colour at the projected tip is that of the largest displacement, at the support
    that of none; the outline at rest is there."""
    problem = plane if dim == 2 else solid
    found = solution(problem)
    options = {"field": "displacement", "loads": False}
    picture = view.show(found, **options, **({} if dim == 2 else {"view": "front"}))
    assert is_whole(picture) and "displacement [mm]" in words(picture)
    image, across = pixels(picture), 0.0 if dim == 2 else 0.01
    low = [[0.0012, across], [0.0588, across - 0.3 * LENGTH]]
    places = low if dim == 2 else [[x, 0.0, z] for x, z in low]
    none, most = (image[y, x] for x, y in picture.pixels(places).astype(int))
    assert none[2] > none[1] and most[0] > 150 and most[2] < 90  # purple to yellow
    without = view.show(found, **options, rest=False, **({} if dim == 2 else {"view": "front"}))
    bare = pixels(without)
    corner = [[0.05, 0.005]] if dim == 2 else [[0.05, 0.0, 0.02]]
    assert patch(picture, image, corner).min() < 200
    assert patch(without, bare, corner).min() > 210  # at most the grid


def test_fields_have_names_units_and_limits(plane):
    found = solution(plane)
    stress = view.show(found, limits=(0.0, 5.0), title="bent")
    assert "von Mises stress [kPa]" in words(stress) and "bent" in words(stress)
    own = view.show(found, field=lambda problem, u: 1e3 * u[:, 1], label="sag [mm]")
    assert "sag [mm]" in words(own)
    cells = view.show(found, field=np.arange(plane.mesh.num_cells), label="number")
    assert is_whole(cells)
    with pytest.raises(ValueError, match="need one of von_mises"):
        view.show(found, field="colour")
    assert (short(12500.0, "Pa"), short(0.0, "Pa"), short(2e6, "Pa")) == (
        "12.5 kPa",
        "0 kPa",
        "2 MPa",
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_states_of_a_path_share_one_scale(dim, plane, solid):
    problem = plane if dim == 2 else solid
    shapes = jnp.stack([bent(problem.mesh, share) for share in (0.0, 0.15, 0.3)])
    pulls = jnp.zeros((3, dim)).at[:, -1].set(jnp.array([0.0, -150.0, -300.0]))
    path = Path(problem, shapes, pulls, "pull", Status.successful, ())
    picture = view.show(path, field="displacement", title="path")
    assert is_whole(picture) and len(picture.panels) == 3
    for name in ("|pull| = 0 kPa", "|pull| = 150 Pa", "|pull| = 300 Pa"):
        assert name in words(picture)
    image = pixels(picture)
    middle = [0.055, -0.25 * LENGTH] if dim == 2 else [0.055, 0.0, -0.22 * LENGTH]
    drawn = [
        image[y, x] for k in range(3) for x, y in picture.pixels([middle], panel=k).astype(int)
    ]
    assert drawn[0].min() > 200 and drawn[2].min() < 120  # only the last reaches there
    assert len(view.show(path, field=None, states=[-1]).panels) == 1
    with pytest.raises(ValueError, match="states 0 to 2"):
        view.show(path, states=[7])
    assert path.problem_at(1).loads[0].value[-1] == -150.0


@pytest.mark.parametrize("dim", [2, 3])
def test_modes_have_their_frequencies(dim, plane, solid):
    problem = plane if dim == 2 else solid
    shape = bent(problem.mesh, 1.0)
    modes = Modes(
        problem,
        0 * shape,
        jnp.array([400.0, 900.0]) * np.pi**2,
        jnp.stack([shape, shape[:, ::-1]]),
    )
    picture = view.show(modes)
    assert is_whole(picture) and len(picture.panels) == 2
    assert "mode 1: 10 Hz" in words(picture) and "mode 2: 15 Hz" in words(picture)


@pytest.fixture(scope="module")
def arm():
    return R.rod(SE3(), R.chebyshev(kappa_y=2, kappa_z=2), R.circle(0.008), **ROD)


def test_a_rod_is_a_tube_where_its_sections_are(arm):
    q = jnp.array([12.0, 0.0, 8.0, 3.0])
    picture = view.show(arm, q)
    assert is_whole(picture, 0.05)
    image = pixels(picture)
    poses = np.asarray(R.forward_kinematics(arm, q, jnp.array([0.0, 0.3, 0.7, 1.0])))
    for x, y in picture.pixels(poses[:, :3, 3]).astype(int):
        assert image[y, x].max() < 250  # the tube covers its centre line
    with pytest.raises(ValueError, match="4 coordinates"):
        view.show(arm, jnp.zeros(3))


def test_threads_directors_and_pressures_are_inside_a_clear_tube(arm):
    routes = (R.Straight([-0.003, 0.003]), R.Straight([-0.003, -0.003], 0.25, 0.75))
    chambers = R.thread_chambers(arm, routes, [1e-5, 2e-5])
    forces = (R.Tendons(R.Helical(0.005, 1.0), 1.5), R.Pressurised(chambers, [2e4, 1e4]))
    picture = view.show(
        arm, jnp.array([6.0, 0, 0, 0]), forces=forces, directors=True, view="right"
    )
    assert is_whole(picture)
    for name in ("tendon: 1.5 N", "chamber: 20 kPa", "chamber: 10 kPa", "director x"):
        assert name in words(picture)
    drawn = acting(arm, forces).threads[""]
    for thread, route, area in zip(drawn[1:], routes, (1e-5, 2e-5), strict=True):
        assert np.allclose(thread.place, route.place, rtol=0, atol=1e-9)  # found again
        assert np.isclose(np.pi * thread.radius**2, area)
        assert np.allclose((thread.start, thread.stop), (route.start, route.stop))


def test_contact_is_an_arrow_and_its_obstacle(arm):
    law = contact.LinePenalty(5e5, 2e-5)
    touching = R.ObstacleContact(sdf.Sphere([0.06, 0.0, -0.0275], 0.02), 0.008, law)
    picture = view.show(arm, forces=(touching,), view="front")
    image = pixels(picture)
    assert is_whole(picture) and "contact, " in words(picture)
    assert near(image, LOAD, 60).sum() > 30 and near(image, OBSTACLE, 70).sum() > 300
    far = R.ObstacleContact(sdf.Sphere([0.06, 0.0, -0.5], 0.02), 0.008, law)
    assert "obstacle" not in words(view.show(arm, forces=(far,)))


def test_a_planar_rod_is_a_band_with_its_states():
    rod = R.rod(SE2(), R.chebyshev(kappa_z=2), R.rectangle(0.02, 0.01), **ROD)
    rows = jnp.array([[0.0, 0.0], [8.0, 0.0], [16.0, 4.0]])
    picture = view.show(rod, rows, forces=(R.Tendons(R.Straight([0.004, 0.0]), 1.5),))
    assert is_whole(picture) and "tendon: 1.5 N" in words(picture)
    image = pixels(picture)
    for k, row in enumerate(rows):
        place = np.asarray(R.forward_kinematics(rod, row, jnp.array([0.93])))[0, :2, 2]
        x, y = picture.pixels(place[None])[0].astype(int)
        assert (image[y + 4, x + 4].min() < 215) == (k == 2)  # the last in full, others pale


@pytest.mark.parametrize(
    "section, corners",
    [
        (R.circle(0.008), 0),
        (R.ring(0.009, 0.006), 0),
        (R.ellipse(0.009, 0.005), 0),
        (R.rectangle(0.02, 0.01), 0),
        (R.squircle(0.008, 5.0), 0),
    ],
)
def test_an_outline_has_the_constants_of_its_section(section, corners):
    outer, hole = sections.section_outline(section)

    def moments(ring):
        y, z = ring.T
        after_y, after_z = np.roll(y, -1), np.roll(z, -1)
        cross = y * after_z - after_y * z
        about_z = np.sum(cross * (y**2 + y * after_y + after_y**2)) / 12
        about_y = np.sum(cross * (z**2 + z * after_z + after_z**2)) / 12
        return np.array([np.sum(cross) / 2, about_y, about_z])

    found = moments(outer) - (0 if hole is None else moments(hole))
    want = [section.area, section.second_moment_y, section.second_moment_z]
    assert np.allclose(found, want, rtol=0.013)  # a polygon of 48 corners is smaller
    assert is_whole(view.show(section))


def test_sections_of_given_shape_keep_their_hole(arm):
    outer, hole = sections.outlines_of(arm, np.array([0.0, 1.0]), RING)
    assert outer.shape == hole.shape and outer.shape[0] == 2
    assert np.allclose(np.linalg.norm(outer[0], axis=1), 0.02, rtol=1e-3)
    assert np.allclose(np.linalg.norm(hole[0], axis=1), 0.008, rtol=5e-3)


def test_an_assembly_is_drawn_with_its_links(arm):
    palm = R.Link(0.05, [2e-5, 2e-5, 3e-5])
    offset = homogeneous(jnp.eye(3), jnp.array([0.03, 0.0, 0.0]))
    hand = R.assembly(SE3(), palm=R.Part(palm), finger=R.Part(arm, on="palm", offset=offset))
    picture = view.show(hand, jnp.array([6.0, 0.0, 0, 0]), view="front")
    assert is_whole(picture)
    image = pixels(picture)
    x, y = picture.pixels([[0.0, 0.0, 0.0]])[0].astype(int)
    assert image[y, x].max() < 250  # the ellipsoid of the palm
    shaped = view.show(hand, shapes={"palm": sdf.Box([-0.03] * 3, [0.03] * 3)}, view="front")
    x, y = shaped.pixels([[-0.028, -0.03, 0.028]])[0].astype(int)
    assert pixels(shaped)[y, x].max() < 250  # the corner of the box


@pytest.fixture(scope="module")
def loop():
    lag = systems.Lag(0.1)
    return systems.Network(
        {
            "target": systems.Source(systems.Step(1.0)),
            "pid": systems.PID(2.0),
            "lag": lag,
            "last": systems.Lag(0.2),
        },
        {
            "pid.reference": "target.value",
            "pid.measurement": "last.value",
            "lag.a": "pid.command",
            "last.a": "lag.value",
        },
    )


def test_a_network_shows_blocks_ports_and_wires(loop):
    picture = view.show(loop, title="loop")
    assert is_whole(picture)
    for word in (*loop.blocks, "PID", "reference", "measurement", "command", "loop"):
        assert word in words(picture)
    places = networks._layout(
        list(loop.blocks),
        dict(loop.wires),
        {n: networks._ports(n, b, set()) for n, b in loop.blocks.items()},
    )
    columns = {name: x for name, (x, _) in places.items()}
    assert columns["target"] < columns["pid"] < columns["lag"] < columns["last"]
    ends = [
        line.get_xydata()[-1]
        for line in picture.panels[0].axes.lines
        if len(line.get_xydata()) > 2
    ]
    assert len(ends) == len(loop.wires)
    assert is_whole(view.show(loop.blocks["pid"]), 0.01)


def test_a_trajectory_has_panels_by_unit(loop):
    time = jnp.linspace(0.0, 1.0, 21)
    outputs = {
        "lag.y": time,
        "pid.command": 1 - time,
        "target.value": jnp.ones(21),
        "last.y": jnp.stack([time, time**2], axis=1),
    }
    stats = {"steps": jnp.asarray(20), "rejected": jnp.asarray(0), "reached": time[-1]}
    film = systems.Trajectory(time, {}, outputs, Status.successful, stats)
    picture = view.show(film)
    assert is_whole(picture) and "time [s]" in words(picture)
    assert "last.y[1]" in words(picture) and len(picture.panels) == 3  # both y in one
    chosen = view.show(film, names=["lag.y"], references={"lag.y": "target.value"})
    assert len(chosen.panels) == 1 and "target.value (reference)" in words(chosen)
    stopped = eqx.tree_at(
        lambda f: (f.status, f.stats["reached"]), film, (Status.not_finite, jnp.asarray(0.5))
    )
    assert "stopped after 0.5 s" in words(view.show(stopped))
    with pytest.raises(ValueError, match="no output 'x'"):
        view.show(film, names=["x"])


def test_an_optimisation_shows_its_history_or_its_layout(beam):
    history = {
        "objective": 1 / np.arange(1.0, 6),
        "constraints": -np.ones((5, 2)),
        "change": 0.5 ** np.arange(5),
    }
    corners = np.asarray(beam.points)[np.asarray(beam.cells)[:, :3]]
    density = (corners[:, :, 0].mean(axis=1) / LENGTH) ** 4
    done = Optimised(
        jnp.asarray(density), jnp.asarray(0.2), -jnp.ones(2), Status.max_steps, history, None
    )
    picture = view.show(done)
    assert len(picture.panels) == 3 and "objective 0.2 after 5 steps" in words(picture)
    layout = view.show(done, mesh=beam, densities=np.stack([0.5 + 0 * density, density]))
    image = pixels(layout)
    assert len(layout.panels) == 2 and "step 2" in words(layout)
    last, first = (layout.pixels([[x, 0.0012]], panel=1)[0].astype(int) for x in (0.059, 0.001))
    assert image[last[1], last[0]].max() < 60 and image[first[1], first[0]].min() > 200
    with pytest.raises(ValueError, match="one .*per cell"):
        view.show(done, mesh=beam, densities=np.zeros(3))


def test_charts_tell_orders_and_refuse_zeros():
    sizes = np.array([1.0, 0.5, 0.25])
    chart = view.Convergence(sizes, {"linear": 3 * sizes**2, "quadratic": sizes**3})
    assert np.allclose(list(chart.orders().values()), [2.0, 3.0])
    picture = view.show(chart)
    assert is_whole(picture) and "quadratic: order 3.00" in words(picture)
    work = view.WorkPrecision({"a": ([1, 2], [1e-2, 1e-4]), "b": ([2, 1], [1e-5, 1e-2])})
    assert is_whole(view.show(work)) and "time [s]" in words(view.show(work))
    with pytest.raises(ValueError, match="must be positive"):
        view.show(view.WorkPrecision({"a": ([1.0], [0.0])}))
    with pytest.raises(ValueError, match="two rows of one length"):
        view.show(view.WorkPrecision({"a": ([1.0, 2.0], [0.1])}))


def test_a_material_and_a_basis_are_curves():
    rubber = view.show(material.neo_hookean(young_modulus=1e5, poisson_ratio=0.49))
    (line,) = [x for x in rubber.panels[0].axes.lines if len(x.get_xdata()) > 2]
    stretch, stress = line.get_data()
    slope = np.diff(np.interp([0.99, 1.01], stretch, stress))[0] / 0.02
    assert np.isclose(slope, 100.0, rtol=0.03)  # Young's modulus [kPa]
    assert is_whole(view.show(R.chebyshev(kappa_z=2), length=0.1))


def test_a_picture_is_saved_as_vectors(tmp_path, loop):
    picture = view.show(loop)
    assert picture.save(tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    svg = picture.save(tmp_path / "a.svg").read_text()
    assert "<svg" in svg and "<image" not in svg
    assert picture.save(tmp_path / "a.png").read_bytes() == picture.png == picture._repr_png_()
    assert "pixels" in repr(picture)
    with pytest.raises(ValueError, match="need one of .png"):
        picture.save(tmp_path / "a.gif")


def test_unknown_types_are_refused_and_can_be_added(loop):
    class Mine:
        pass

    with pytest.raises(TypeError, match="got a Mine, need one of AbstractBlock"):
        view.show(Mine())
    view.show.register(Mine, lambda mine, **options: view.show(loop, **options))
    assert is_whole(view.show(Mine(), title="mine"))
    assert "title" in __import__("inspect").signature(view.options(loop)).parameters


def test_notebooks_get_a_picture_where_there_is_one(beam, arm, loop):
    for noun in (beam, loop, RING):
        assert noun._repr_png_().startswith(b"\x89PNG")
    assert sdf.HalfPlane([0.0, 0.0], [0.0, 1.0])._repr_png_() is None  # unbounded
    seen = []
    jax.jit(lambda rod: seen.append((rod._repr_png_(), repr(rod))) or rod.length)(arm)
    assert seen[0][0] is None and "length ?" in seen[0][1]


def test_nouns_print_what_matters(beam, plane, arm, loop):
    assert repr(beam).splitlines()[0] == "Mesh: 48 Tri6 cells, 125 nodes"
    assert "left" in repr(beam)
    assert "largest displacement 0.018 m" in repr(solution(plane))
    assert repr(arm).startswith("Rod in SE3: length 0.12 m, modes kappa_y 2, kappa_z 2")
    assert "  pid.command -> lag.a" in repr(loop).splitlines()
    assert repr(sdf.Circle([0.0, 0.0], 0.02)) == "Circle(center=[0, 0], radius=0.02)"
    hand = R.assembly(SE3(), arm=R.Part(arm))
    assert "arm: Rod, Fixed joint on the ground" in repr(hand)
    empty = jax.tree.map(lambda x: None, arm)  # what transformations put in
    assert isinstance(repr(empty), str)
    assert isinstance(repr(jax.eval_shape(lambda: beam)), str)


def test_scenes_are_put_together_anew(plane):
    ball, arm = sdf.Sphere([0.0, 0.0, 0.0], 0.01), np.array([[0.0, 0, 0], [0, 0, 0.03]])
    lone = view.scene_of(ball, size=0.004)
    both = view.merge_scenes(lone, view.Scene((view.Lines([arm]),)), title="ball on a stick")
    assert len(both.parts) == 2 and both.title == "ball on a stick"
    shown = view.show(both, view="front", renderer="own")
    lower, upper = both.box
    at = shown.pixels(np.array([[0.0, 0, 0.02], [0.0, 0, 0.005]]))
    image = pixels(shown)
    assert image[int(at[0, 1]), int(at[0, 0])].max() < 90 and np.isclose(upper[2], 0.03)
    assert 100 < image[int(at[1, 1]), int(at[1, 0]) - 20].max() < 250
    assert view.scene_of(plane).dim == 2
    with pytest.raises(TypeError, match="need one of AbstractSdf, Assembly"):
        view.scene_of(3.0)


QUIET = """
import jax; jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp, sys
import sorojax as sj
sj.enable_compilation_cache()
rod = sj.rod.rod(sj.SE2(), sj.rod.chebyshev(kappa_z=1), sj.rod.circle(0.01), length=0.1,
                 young_modulus=1e5, poisson_ratio=0.4, density=1e3, nodes=4)
film = sj.systems.simulate(sj.systems.Network({"lag": sj.systems.Lag(0.1)}, {}, ("lag.a",)),
                           0.01, inputs={"lag.a": 1.0}, save=3)
print(sj.mesh.rectangle([0, 0], [1, 1], divisions=(1, 1)), rod, film)
print(sorted({"matplotlib", "PIL", "pyvista", "sorojax.view"} & sys.modules.keys()))
"""


def test_simulating_and_printing_load_no_drawing_library():
    done = subprocess.run([sys.executable, "-c", QUIET], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"


def test_every_class_that_is_drawn_exists():
    """They are listed by name, so that a picture of a shape does not import the solvers."""
    tables = sys.modules["sorojax.view.show"]
    for function, nouns in (tables._PICTURES | tables._SCENES).items():
        module, _, name = f"sorojax.view.{function}".rpartition(".")
        assert callable(getattr(importlib.import_module(module), name))
        for noun in nouns.split():
            home, _, name = f"sorojax.{noun}".rpartition(".")
            assert getattr(importlib.import_module(home), name).__module__ == home, noun
