"""Solid meshes: size fields, interfaces, foreign surfaces, walls that are refused."""

import importlib.util
import shutil

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import io, mesh as M, sdf
from sorojax.mesh.mesh import facet_table

BALL = sdf.Sphere([0, 0, 0], 1)


def layers(v):
    """A can of radius v[0] and a layer in it up to the height v[1]."""
    upper = jnp.stack([jnp.ones_like(v[1]), jnp.ones_like(v[1]), v[1]])
    return sdf.Cylinder(v[0], 1), sdf.Box([-1, -1, -2], upper)


@pytest.fixture(scope="module")
def divided():
    shape, layer = layers(np.array([0.5, 0.1]))
    return M.tetrahedralise(shape, size=0.2, interfaces=(layer,))


def conforms(mesh):
    """Whether every triangle has at most two cells and all cells are upright."""
    count = facet_table(mesh)[2]
    return count.max() == 2 and bool(jnp.all(M.cell_volumes(mesh) > 0))


def test_cells_follow_a_size_field():
    near = sdf.Sphere([0, 0, 1], 0.1)
    mesh = M.tetrahedralise(BALL, size=M.grade(near, near=0.05, far=0.3, growth=0.5))
    quality = M.quality(mesh)
    assert conforms(mesh) and quality.watertight and not quality.inverted
    assert np.rad2deg(quality.min_angle) > 14 and abs(quality.area / 4.18879 - 1) < 0.02
    pitch = np.cbrt(12 * np.asarray(M.cell_volumes(mesh)))
    x = np.asarray(mesh.points)[np.asarray(mesh.cells)].mean(axis=1)
    close = np.linalg.norm(x - [0, 0, 1], axis=1) < 0.2
    assert pitch[close].mean() < 0.09 and pitch[x[:, 2] < 0].mean() > 0.17
    assert len(set(quality.worst)) == 8 and sum(quality.histogram) == mesh.num_cells


def test_interfaces_are_facets_of_the_mesh(divided):
    facets = np.asarray(divided.facet_sets["interface_0"])
    x = np.asarray(divided.points)[facets]
    normal = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]) / 2
    assert conforms(divided) and M.quality(divided).watertight
    assert np.rad2deg(M.quality(divided).min_angle) > 15
    assert np.abs(x[..., 2] - 0.1).max() < 1e-15 and (normal[:, 2] > 0).all()
    rim = np.intersect1d(facets, divided.facet_sets["boundary"])
    assert np.allclose(np.hypot(*np.asarray(divided.points)[rim, :2].T), 0.5, rtol=1e-12)
    lower = np.asarray(M.cell_volumes(divided))[divided.regions["inside_0"]].sum()
    assert np.isclose(lower, 0.6 * normal[:, 2].sum(), rtol=1e-2)  # of a faceted can
    with pytest.raises(ValueError, match="does not pass"):
        M.tetrahedralise(BALL, size=0.4, interfaces=(sdf.Sphere([3, 0, 0], 1),))


def test_interfaces_cross_and_curve():
    box, flat = sdf.Box([0, 0, 0], [2, 1, 1]), sdf.Box([-1, -1, -1], [3, 2, 0.33])
    ball = sdf.Sphere([1, 0.5, 0.5], 0.35)
    mesh = M.tetrahedralise(box, size=0.25, interfaces=(flat, ball), order=2)
    volumes = np.asarray(M.cell_volumes(mesh))
    assert conforms(mesh) and np.isclose(volumes.sum(), 2, rtol=1e-12)
    assert np.isclose(volumes[mesh.regions["inside_0"]].sum(), 0.66, rtol=1e-12)
    inside = volumes[mesh.regions["inside_1"]].sum()
    around = -M.enclosed_volume(mesh, np.asarray(mesh.facet_sets["interface_1"]))
    assert np.isclose(inside, around, rtol=1e-9)
    flat, ball = sdf.Box([-1, -1, -1], [3, 2, 0.331]), sdf.Sphere([1.002, 0.5, 0.5], 0.351)
    moved = M.move(mesh, box, interfaces=(flat, ball))
    assert conforms(moved)
    for interface, name in ((flat, "interface_0"), (ball, "interface_1")):
        facets = np.asarray(mesh.facet_sets[name])[:, :3]
        assert jnp.abs(interface(moved.points[np.unique(facets)])).max() < 1e-12


@pytest.mark.parametrize("thickness, message", [(0.01, "lower `size`"), (0.1, "a layer")])
def test_layers_thinner_than_a_cell_are_refused(thickness, message):
    box, layer = sdf.Box([0, 0, 0], [1, 1, 1]), sdf.Box([-1, -1, 0.4], [2, 2, 0.4 + thickness])
    with pytest.raises(ValueError, match=message):
        M.tetrahedralise(box, size=0.25, interfaces=(layer,))


def test_interfaces_move_with_their_parameters(divided):
    @jax.jit
    def points(v):
        shape, layer = layers(v)
        return M.move(divided, shape, interfaces=(layer,)).points

    v, way, step = np.array([0.5, 0.1]), np.array([1.0, 0.7]), 1e-6
    assert jnp.abs(points(v) - divided.points).max() < 1e-9
    moved = points(v + np.array([0.02, 0.03]))
    assert jnp.abs(moved[divided.node_sets["interface_0"], 2] - 0.13).max() < 1e-12
    exact = jax.jvp(points, (v,), (way,))[1]
    central = (points(v + step * way) - points(v - step * way)) / (2 * step)
    assert jnp.abs(exact - central).max() < 1e-6


def test_a_printed_part_becomes_a_mesh(tmp_path):
    """STL to mesh: import_surface, sdf.TriangleMesh, tetrahedralise."""
    block = sdf.Box([0, 0, 0], [40e-3, 30e-3, 20e-3])
    io.export_surface(tmp_path / "part.stl", sdf.isosurface(block, 10e-3, "dual_contouring"))
    surface = io.import_surface(tmp_path / "part.stl")
    part = sdf.TriangleMesh(surface.vertices, surface.triangles)
    mesh = M.tetrahedralise(part, size=10e-3, rounds=4)
    quality = M.quality(mesh)
    assert quality.watertight and np.isclose(quality.area, 24e-6, rtol=1e-6)
    assert len(mesh.node_sets["corners"]) == 8 and np.rad2deg(quality.min_angle) > 10


@pytest.mark.parametrize("mesher", ["pytetwild", "gmsh"])
def test_other_meshers_take_surfaces(mesher, monkeypatch, tmp_path):
    surface = sdf.isosurface(sdf.Box([0, 0, 0], [1, 0.8, 0.6]), 0.1, "dual_contouring")
    with pytest.raises(ValueError, match="need .pytetwild. or .gmsh."):
        io.mesh_surface(surface, 0.2, mesher="other")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="need 1 .Tet4. or 2 .Tet10."):
        io.mesh_surface(surface, 0.2, mesher=mesher, order=3)
    if mesher == "gmsh":
        half = sdf.Surface(surface.vertices, surface.triangles[::2])
        if shutil.which("gmsh"):
            with pytest.raises(ValueError, match="one closed shell"):
                io.mesh_surface(half, 0.2, mesher="gmsh")
        else:
            with pytest.raises(FileNotFoundError, match="PATH"):
                io.mesh_surface(surface, 0.2, mesher="gmsh")
            pytest.skip("no gmsh on the PATH")
    elif importlib.util.find_spec("pytetwild") is None:
        with pytest.raises(ModuleNotFoundError, match="pip install"):
            io.mesh_surface(surface, 0.2)
        pytest.skip("pytetwild is not installed")
    monkeypatch.chdir(tmp_path)
    quality = M.quality(io.mesh_surface(surface, 0.2, mesher=mesher))
    assert quality.watertight and np.isclose(quality.area, 0.48, rtol=2e-2)
    assert not list(tmp_path.iterdir())  # nothing is left where it runs
    ten = io.mesh_surface(surface, 0.2, mesher=mesher, order=2)
    assert ten.element.name == "Tet10" and ten.facet_sets["boundary"].shape[1] == 6


def bored(wall, radius=0.15):
    """A cube with a bore that leaves `wall` of one side."""
    cut = sdf.translate(sdf.Cylinder(radius, 4), [0.5 - radius - wall, 0.013, 0])
    return sdf.Box([-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]) - cut


def test_a_wall_of_a_quarter_of_the_size_is_meshed():
    quality = M.quality(M.tetrahedralise(bored(0.03), size=0.12))
    assert quality.watertight and np.isclose(quality.area, 1 - np.pi * 0.15**2, rtol=1e-2)


def test_bad_solids_are_refused_with_the_remedy():
    with pytest.raises(ValueError, match="Lower `size`"):
        M.tetrahedralise(bored(0.0035), size=0.12)
    with pytest.raises(ValueError, match="empty"):
        M.tetrahedralise(BALL & sdf.Sphere([1.8, 0.9, 0], 1), size=0.3)
    lost = eqx.tree_at(lambda s: s.radius, BALL, jnp.asarray(np.nan))
    with pytest.raises(ValueError, match="NaN|finite"):
        M.tetrahedralise(lost, size=0.3)
    bow = [[0, 0], [1, 0], [0.5, 0.5], [1, 1], [0, 1], [0.5, 0.5]]
    with pytest.raises(ValueError, match="touches or crosses"):
        M.from_polygon(np.array(bow), size=0.1)


def test_what_gmsh_said_last_is_told(tmp_path, monkeypatch):
    program = tmp_path / "gmsh"
    program.write_text(
        "#!/bin/sh\nprintf 'noise %.0s' $(seq 100) >&2\necho 'no volume' >&2\nexit 1\n"
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    ball = sdf.isosurface(BALL, 0.5)
    with pytest.raises(ValueError, match=r"gmsh failed \(.{290} no volume\)"):
        io.mesh_surface(ball, 0.5, mesher="gmsh")
