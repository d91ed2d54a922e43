"""Surface files: there and back, and files that are not what they say."""

import json
import os
import xml.etree.ElementTree as xml
import zipfile

import numpy as np
import pytest

from sorojax import io, sdf
from sorojax.units import mm

BOX = sdf.isosurface(
    sdf.Box([0, 0, 0], [30 * mm, 20 * mm, 10 * mm]), 2.3 * mm, "dual_contouring"
)
HEAD = b"x" * 80
KINDS = [("a.stl", False), ("a.stl", True), ("a.obj", False), ("a.ply", False), ("a.ply", True)]


@pytest.mark.parametrize("name, text", KINDS)
@pytest.mark.parametrize("unit", [mm, 1.0])
@pytest.mark.versions
def test_surfaces_come_back(tmp_path, name, text, unit):
    io.export_surface(tmp_path / name, BOX, text=text, unit=unit)
    back = io.import_surface(tmp_path / name, unit=unit)
    report = sdf.surface_report(back)
    assert report.manifold and len(back.triangles) == len(BOX.triangles)
    assert abs(report.volume / sdf.surface_report(BOX).volume - 1) < 1e-6
    assert os.listdir(tmp_path) == [name]  # no temporary file stays


def test_stl_is_in_millimetres(tmp_path):
    io.export_surface(tmp_path / "a.stl", BOX)
    metres = io.import_surface(tmp_path / "a.stl", unit=1.0)
    assert np.allclose(np.ptp(metres.vertices, axis=0), [30, 20, 10], atol=0.01)


def test_3mf_and_glb_hold_what_they_declare(tmp_path):
    io.export_surface(tmp_path / "a.3mf", BOX)
    with zipfile.ZipFile(tmp_path / "a.3mf") as package:
        model = xml.fromstring(package.read("3D/3dmodel.model"))
        parts = [
            xml.fromstring(package.read(n)) for n in ("[Content_Types].xml", "_rels/.rels")
        ]
    kinds = "http://schemas.openxmlformats.org/package/2006"
    assert [part.tag for part in parts] == [
        f"{{{kinds}/content-types}}Types", f"{{{kinds}/relationships}}Relationships"
    ]  # fmt: skip
    space = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"
    assert model.get("unit") == "millimeter"
    assert len(list(model.iter(space + "vertex"))) == len(BOX.vertices)
    assert len(list(model.iter(space + "triangle"))) == len(BOX.triangles)
    io.export_surface(tmp_path / "a.glb", BOX)
    data = (tmp_path / "a.glb").read_bytes()
    magic, version, length, chunk = np.frombuffer(data, "<u4", 4)
    assert (magic, version, length) == (0x46546C67, 2, len(data))
    scene = json.loads(data[20 : 20 + chunk])
    assert scene["accessors"][1]["count"] == BOX.triangles.size


@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "3mf", "glb"])
def test_another_program_reads_the_same_body(tmp_path, ending):
    trimesh = pytest.importorskip("trimesh")
    if ending == "3mf":
        pytest.importorskip("lxml"), pytest.importorskip("networkx")
    body = sdf.Gyroid(8 * mm, 0.3) & sdf.Box([-5 * mm] * 3, [5 * mm] * 3)
    surface = sdf.isosurface(body, 0.6 * mm)
    io.export_surface(tmp_path / f"a.{ending}", surface)
    read = trimesh.load(tmp_path / f"a.{ending}", force="mesh")
    assert read.is_watertight and read.is_winding_consistent
    unit = 1.0 if ending == "glb" else mm
    assert abs(read.volume * unit**3 / sdf.surface_report(surface).volume - 1) < 1e-6


def test_contours_become_svg(tmp_path):
    ring = sdf.Circle([0, 0], 10 * mm) - sdf.Circle([0, 0], 5 * mm)
    io.export_contour(tmp_path / "a.svg", sdf.contour(ring, 1 * mm))
    picture = xml.parse(tmp_path / "a.svg").getroot()
    (path,) = list(picture)
    assert path.get("d", "").count("Z") == 2
    assert float(picture.get("width", "0mm")[:-2]) == pytest.approx(20, abs=0.2)


def stl(*corners, count=None):
    """Bytes of a binary STL."""
    body = b"".join(
        np.zeros(3, "<f4").tobytes() + np.array(c, "<f4").tobytes() + b"\0\0" for c in corners
    )
    return HEAD + np.uint32(len(corners) if count is None else count).tobytes() + body


TRIANGLE = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
TEXT = b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
END = b"endloop\nendfacet\nendsolid a\n"
PLY = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
FACES = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
BAD = {
    "declares 4294967295": ("a.stl", stl(TRIANGLE, count=2**32 - 1) + b"\0" * 900),
    "web page": ("a.stl", b"<!DOCTYPE html><html><body>404 not found</body></html>" * 9),
    "truncated": ("b.stl", stl(TRIANGLE, TRIANGLE)[:-30]),
    "text STL has 1 facets, 0": ("c.stl", TEXT),
    "1 facets, 0 ends of facets and 3": ("i1.stl", TEXT + b"endloop\nendsolid a\n"),
    "1 facets, 1 ends of facets and 2": ("i2.stl", TEXT.replace(b"vertex 0 1 0\n", b"") + END),
    "1 facets, 1 ends of facets and 4": ("i3.stl", TEXT + b"vertex 1 1 0\n" + END),
    "2 facets, 1 ends of facets and 3": ("i4.stl", TEXT + b"facet normal 0 0 1\n" + END),
    "1 facets, 1 ends of facets and 3": ("i5.stl", TEXT + END.replace(b"endsolid a\n", b"")),
    "2 facets, 2 ends of facets and 6": (  # as many as needed, four in one and two in the other
        "i6.stl",
        TEXT + b"vertex 1 1 0\n" + END[:17] + TEXT[8:].replace(b"vertex 0 1 0\n", b"") + END,
    ),
    "no number": ("d.stl", TEXT.replace(b"vertex 0 1 0", b"vertex 0 one 0") + END),
    "finite coordinates": ("e.stl", stl([[0, 0, np.nan], [1, 0, 0], [0, 1, 0]])),
    "vertex .* is .*1.*e\\+30": ("f.stl", stl([[0, 0, 1e30], [1, 0, 0], [0, 1, 0]])),
    "finite coordinates below": ("g.stl", TEXT.replace(b"1 0 0", b"nan 0 0") + END),
    "holds no triangle": ("h.stl", stl()),
    "truncated or no STL": ("i.stl", b""),
    "uses vertices": ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n"),
    "line 4": ("b.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 2147483648\n"),
    "line 1": ("c.obj", b"v 0 zero 0\n"),
    "no x, y and z": ("a.ply", PLY.replace(b"ascii", b"binary_little_endian") + FACES),
    "are left": (
        "b.ply",
        PLY.replace(b"ascii", b"binary_little_endian").replace(b"x 3", b"x 4000000000")
        + b"property float z\n" + FACES,
    ),
    "rows of `vertex`": ("c.ply", PLY + b"property float z\n" + FACES.replace(b"1", b"9", 1)),
    "begins with": ("d.ply", b"GIF89a"),
    "header says": ("e.ply", PLY + b"property quaternion q\n" + FACES),
    "ends in": ("a.step", b"ISO-10303-21;"),
}  # fmt: skip


@pytest.mark.parametrize("message", BAD)
@pytest.mark.stress(33)
def test_bad_files_name_the_remedy(tmp_path, message):
    name, data = BAD[message]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ValueError, match=message) as caught:
        io.import_surface(tmp_path / name)
    assert str(caught.value).startswith("import_surface")


@pytest.mark.stress(61)
@pytest.mark.parametrize("written", [1.0, 1e-7, 0.0254])
def test_a_size_that_no_part_has_in_millimetres_needs_its_unit(tmp_path, written):
    """A part of 20 mm whose file is in metres, tenths of a micrometre or inches."""
    shape = sdf.Box([0, 0, 0], [20e-3, 15e-3, 10e-3])
    io.export_surface(tmp_path / "a.stl", sdf.isosurface(shape, size=2e-3), unit=written)
    with pytest.raises(ValueError, match=r"a\.stl: its longest side is .*, need .*unit="):
        io.import_surface(tmp_path / "a.stl")
    back = io.import_surface(tmp_path / "a.stl", unit=written)
    assert np.allclose(np.ptp(back.vertices, axis=0), [20e-3, 15e-3, 10e-3], rtol=1e-5)
    tiny = io.import_surface(tmp_path / "a.stl", unit=1e-6)  # as asked for
    assert np.ptp(tiny.vertices, axis=0)[0] == pytest.approx(20e-3 / written * 1e-6)


@pytest.mark.stress(33)
def test_text_and_binary_are_told_apart_by_length(tmp_path):
    binary = b"solid facet ".ljust(80) + stl(TRIANGLE)[80:]
    (tmp_path / "a.stl").write_bytes(binary)
    assert len(io.import_surface(tmp_path / "a.stl").triangles) == 1
    (tmp_path / "b.stl").write_bytes(b"\n  SOLID" + TEXT[5:].upper() + END)
    assert len(io.import_surface(tmp_path / "b.stl").triangles) == 1


@pytest.mark.stress(34)
def test_large_files_are_refused_unread(tmp_path):
    path = tmp_path / "a.stl"
    with open(path, "wb") as file:
        file.truncate(10_000_000_000)
    with pytest.raises(ValueError, match="10000000000 bytes"):
        io.import_surface(path)


@pytest.mark.stress(35)
def test_paths_stay_below_their_root(tmp_path):
    root, outside = tmp_path / "root", tmp_path / "outside"
    root.mkdir(), outside.mkdir()
    io.export_surface(outside / "secret.stl", BOX)
    (root / "link.stl").symlink_to(outside / "secret.stl")
    (root / "folder").symlink_to(outside)
    wanted = [
        "../outside/secret.stl",
        str(outside / "secret.stl"),
        "link.stl",
        "folder/new.stl",
    ]
    for path in wanted:
        with pytest.raises(ValueError, match="leads to"):
            io.import_surface(path, root=root)
        with pytest.raises(ValueError, match="leads to"):
            io.export_surface(path, BOX, root=root)
    io.export_surface("mine.stl", BOX, root=root)
    assert len(io.import_surface("mine.stl", root=root).triangles) == len(BOX.triangles)
    assert os.listdir(outside) == ["secret.stl"]


def test_a_failed_export_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.stl"
    io.export_surface(path, BOX)
    before = path.read_bytes()
    monkeypatch.setattr("sorojax.io.surface._pieces", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        io.export_surface(path, BOX)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["a.stl"]


def test_bad_surfaces_are_not_written(tmp_path):
    cases = {
        "no triangle": sdf.Surface(np.zeros((0, 3)), np.zeros((0, 3), int)),
        "use vertices": sdf.Surface(np.zeros((3, 3)), np.array([[0, 1, 3]])),
        "finite": sdf.Surface(np.full((3, 3), np.nan), np.array([[0, 1, 2]])),
    }
    for message, surface in cases.items():
        with pytest.raises(ValueError, match=message):
            io.export_surface(tmp_path / "a.stl", surface)
    with pytest.raises(ValueError, match="export_contour"):
        io.export_surface(tmp_path / "a.svg", BOX)
    assert os.listdir(tmp_path) == []


def test_seams_that_do_not_quite_close_are_welded(tmp_path):
    corners = BOX.vertices[BOX.triangles]
    seam = np.abs(corners[..., 0] - corners[..., 0].max()) < 1e-9
    corners[seam] += np.random.default_rng(0).uniform(-1e-6, 1e-6, (seam.sum(), 3))
    loose = sdf.Surface(corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3))
    io.export_surface(tmp_path / "a.stl", loose)
    open_ = sdf.surface_report(io.import_surface(tmp_path / "a.stl"))
    assert len(open_.open_edges) and "weld=" in repr(open_)
    closed = io.import_surface(tmp_path / "a.stl", weld=10e-6)
    assert sdf.surface_report(closed).manifold and len(closed.vertices) == len(BOX.vertices)
    assert np.isclose(sdf.surface_report(closed).volume, 6e-6, rtol=1e-3)
    with pytest.raises(ValueError, match="half of a usual edge"):
        io.import_surface(tmp_path / "a.stl", weld=2.0)
    with pytest.raises(ValueError, match="need 0 or more"):
        io.import_surface(tmp_path / "a.stl", weld=-1e-6)


def test_triangles_within_a_weld_vanish(tmp_path):
    thin = [[0, 0, 0], [30, 0, 0], [30, 1e-4, 0]]
    data = stl(*(BOX.vertices[BOX.triangles] / mm), thin)
    (tmp_path / "a.stl").write_bytes(data)
    assert len(io.import_surface(tmp_path / "a.stl").triangles) == len(BOX.triangles) + 1
    back = io.import_surface(tmp_path / "a.stl", weld=1e-6)
    assert len(back.triangles) == len(BOX.triangles)
