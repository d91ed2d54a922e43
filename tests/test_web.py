"""Pages and GLB files: what they hold, and what a real browser makes of a page."""

import base64
import json
import re
import struct
import zlib

import chromium
import jax.numpy as jnp
import numpy as np
import pytest
from patches import patch

from benchmarks.cases import view_web
from sorojax import fem, material, mesh as M, view
from sorojax.fem.equilibrium.solve import Path
from sorojax.math.status import Status
from sorojax.sdf import Surface, surface_report
from sorojax.view.rigging.rig import placed
from sorojax.view.web.actor import mesh_triangles
from sorojax.view.web.page import Page

SQUARE = Surface(
    np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
)


@pytest.fixture(scope="module")
def grasp():
    """The page of three fingers and a ball: 20k triangles, 200 frames."""
    actors = view_web.actors()
    time = np.linspace(0, view_web.SECONDS, view_web.FRAMES)
    return actors, view.to_html(*actors, time=time, title="grasp <3>")


def unpacked(page):
    """What a browser reads from a page: its description and its bytes."""
    texts = dict(re.findall(r'<script type="[a-z/]+" id="(\w+)">(.*?)</script>', page.html))
    return json.loads(texts["meta"]), zlib.decompress(base64.b64decode(texts["data"]))


def numbers(block, raw):
    """Levels of a block of frames, as the page's script finds them."""
    shape, count = block["shape"], int(np.prod(block["shape"]))
    low, high = (np.frombuffer(raw, np.uint8, count, block["at"] + k * count) for k in (0, 1))
    folded = low.astype(np.int32) | high.astype(np.int32) << 8
    steps = ((folded >> 1) ^ -(folded & 1)).reshape(shape)
    for _ in range(block["order"]):
        steps = np.cumsum(steps, axis=0)
    return steps.astype(np.int16)


def test_a_grasp_is_a_small_page(grasp):
    actors, page = grasp
    assert sum(len(each.triangles) for each in actors) > 20_000
    assert max(each.num_frames for each in actors) == 200
    assert len(page.html.encode()) < 12e6
    assert "http://" not in page.html and "https://" not in page.html
    assert "<title>grasp &lt;3&gt;</title>" in page.html
    assert "MB" in repr(page) and "srcdoc" in Page("<p>")._repr_html_()


def test_a_page_keeps_points_to_its_resolution(grasp):
    actors, page = grasp
    meta, raw = unpacked(page)
    fingers, ball = meta["actors"]
    for info, made in ((fingers, actors[0]), (ball, actors[1])):
        low, high = np.array(info["low"]), np.array(info["high"])
        levels = np.moveaxis(numbers(info["points"], raw), 1, 2)
        points = (low + high) / 2 + (high - low) / 2 * levels / 32767
        assert np.all(np.abs(points - made.points) <= 0.51 * (high - low) / 65534)
    poses = np.frombuffer(raw, "<f4", ball["poses"]["count"], ball["poses"]["at"])
    assert np.allclose(poses.reshape(-1, 4, 4).swapaxes(1, 2), actors[1].poses, atol=1e-6)
    assert meta["stamps"][-1] == "t = 4.00 s" and meta["speed"] == 1
    assert np.all(np.array(meta["box"][0]) <= actors[0].points.min(axis=(0, 1)))


@pytest.fixture(scope="module")
def wave():
    """A result of fem on a plane mesh: a strip that is pulled, with a value at each node."""
    mesh = M.rectangle([0.0, 0.0], [0.1, 0.02], divisions=(10, 2), order=2)
    problem = fem.problem(
        mesh,
        material.neo_hookean(young_modulus=1e5, poisson_ratio=0.4),
        kinematics=fem.PlaneStrain(0.02),
        supports=(fem.Fixed(M.nodes_where(mesh, lambda p: p[0] <= 0)),),
        loads=(fem.Traction(M.boundary_facets(mesh)[:2], [0.0, 0.0], name="pull"),),
    )
    u = jnp.stack([k * mesh.points * jnp.array([[0.1, -0.05]]) for k in range(3)])
    return Path(problem, u, jnp.array([0.0, 1.0, 2.0]), "pull", Status.successful, ())


def test_a_result_brings_its_times_and_colours(wave):
    page = view.to_html(
        view.actor(wave, field=lambda problem, u: u[:, 0]), wave, label="displacement [m]"
    )
    meta, raw = unpacked(page)
    coloured, plain = meta["actors"]
    assert meta["stamps"] == ["pull = 0", "pull = 1", "pull = 2"] and plain["values"] is None
    assert np.allclose(meta["limits"], [0.0, 0.02])
    levels = numbers(coloured["values"], raw)
    assert levels.shape[0] == 3 and levels[0].max() == -127 and levels[2].max() == 127
    assert coloured["triangles"]["count"] == 3 * 4 * wave.problem.mesh.num_cells


@pytest.mark.parametrize("element", [M.Tet4(), M.Hex8(), M.Quad4(), M.Tri3()])
def test_meshes_are_covered_by_triangles_that_face_outwards(element):
    mesh = patch(element)
    nodes, rows = mesh_triangles(mesh)
    points = np.pad(np.asarray(mesh.points)[nodes], ((0, 0), (0, 3 - element.dim)))
    if element.dim == 3:
        report = surface_report(Surface(points, rows))
        assert report.watertight and report.volume == pytest.approx(1.0, rel=1e-12)
    else:
        a, b, c = np.moveaxis(points[rows], 1, 0)
        assert np.sum(np.cross(b - a, c - a)[:, 2]) / 2 == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: view.to_html(), "nothing to show"),
        (lambda: view.actor(3.0), "view.rig"),
        (lambda: view.actor(SQUARE, values=np.zeros(3)), "one number per point"),
        (lambda: view.actor(SQUARE._replace(triangles=[[0, 1, 9]])), "name some of 4"),
        (lambda: view.to_html(view.actor(SQUARE, colour="red")), "#0072B2"),
        (lambda: view.to_html(view.actor(SQUARE), time=[0.0, 1.0]), "1 finite numbers"),
        (lambda: view.actor(SQUARE, poses=np.full((2, 4, 4), np.nan)), "finite"),
        (lambda: view.to_glb("a.gltf", view.actor(SQUARE)), "need .glb"),
    ],
)
def test_errors_say_what_to_do(call, words):
    with pytest.raises((ValueError, TypeError), match=words):
        call()


def glb_of(path):
    """The description and the bytes of a GLB file."""
    data = path.read_bytes()
    magic, version, total, length, kind = struct.unpack("<5I", data[:20])
    assert (magic, version, total, kind) == (0x46546C67, 2, len(data), 0x4E4F534A)
    scene = json.loads(data[20 : 20 + length])
    size, kind = struct.unpack("<2I", data[20 + length : 28 + length])
    assert kind == 0x004E4942 and size == scene["buffers"][0]["byteLength"]
    return scene, data[28 + length :]


def read(scene, body, index):
    """Numbers of an accessor, normalised ones between -1 and 1."""
    entry = scene["accessors"][index]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[entry["type"]]
    kind = {5126: "<f4", 5125: "<u4", 5122: "<i2", 5121: "u1"}[entry["componentType"]]
    here = scene["bufferViews"][entry["bufferView"]]
    stride = here.get("byteStride", width * np.dtype(kind).itemsize)
    rows = np.ndarray(
        (entry["count"], width),
        kind,
        body,
        here["byteOffset"],
        (stride, np.dtype(kind).itemsize),
    )
    return rows / np.iinfo(kind).max if entry.get("normalized") else rows


def test_a_glb_file_moves_as_the_actors(grasp, tmp_path):
    fingers, ball = grasp[0]
    actors = [
        fingers._replace(points=fingers.points[::49]),
        ball._replace(poses=ball.poses[::49]),
    ]
    path = view.to_glb(tmp_path / "grasp.glb", *actors, time=0.1 * np.arange(5))
    scene, body = glb_of(path)
    fingers, _, ball, carrier, root = scene["nodes"]
    primitive = scene["meshes"][fingers["mesh"]]["primitives"][0]
    rest = read(scene, body, primitive["attributes"]["POSITION"])
    half, centre = np.array(fingers["scale"]), np.array(fingers["translation"])
    for k, target in enumerate(primitive["targets"], start=1):
        moved = centre + half * (rest + read(scene, body, target["POSITION"]))
        assert np.allclose(moved, actors[0].points[k], rtol=0, atol=2e-5 * half.max())
    rows = read(scene, body, primitive["indices"]).reshape(-1, 3)
    assert np.array_equal(rows, actors[0].triangles)
    samplers = scene["animations"][0]["samplers"]
    channels = {
        (c["target"]["node"], c["target"]["path"]): samplers[c["sampler"]]
        for c in scene["animations"][0]["channels"]
    }
    weights = read(scene, body, channels[0, "weights"]["output"]).reshape(5, 4)
    assert np.array_equal(weights, np.eye(5)[:, 1:])
    places = read(scene, body, channels[3, "translation"]["output"])
    assert np.allclose(places, actors[1].poses[:, :3, 3], atol=1e-7)
    assert carrier["children"] == [2] and scene["scenes"][0]["nodes"] == [4] and "mesh" in ball
    assert root["children"] == [1, 3]


def test_quaternions_of_a_file_turn_like_the_matrices():
    from sorojax.io.animation import _quaternions

    rng = np.random.default_rng(0)
    q = rng.normal(size=(50, 4))
    q[:4] = np.eye(4)  # half turns and none
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    turned = np.asarray(placed(np.eye(3), np.zeros((50, 3)), q[:, [3, 0, 1, 2]]))
    found = _quaternions(turned.swapaxes(1, 2))
    assert np.allclose(np.abs(np.sum(found * q, axis=1)), 1.0, rtol=0, atol=1e-12)
    assert np.all(np.sum(found[1:] * found[:-1], axis=1) >= 0)


@chromium.needed
def test_a_browser_plays_the_page(grasp, tmp_path):
    file = grasp[1].save(tmp_path / "grasp.html")
    with chromium.tab() as tab:
        tab.call("Page.navigate", url=file.as_uri())
        tab.wait("Boolean(window.viewer && window.viewer.ready)")
        assert tab.run("viewer.state.playing") and tab.run("viewer.frames") == 200
        tab.wait("viewer.state.frame > 2")  # it plays by itself
        tab.run("viewer.play(false), viewer.show(0)")
        first = tab.picture()
        paper = np.all(first[40:540, 10:-10] > 250, axis=2)
        assert 0.1 < np.mean(~paper) < 0.6  # something is drawn, with room around it
        red, green, blue = np.moveaxis(first, 2, 0)
        assert np.sum((red > green + 60) & (green > blue)) > 2000  # the ball
        high, wide = (
            np.flatnonzero(np.any((red > green + 60) & (green > blue), axis=k)) for k in (1, 0)
        )
        tab.run(
            "(s => {s.value = 120; s.dispatchEvent(new Event('input'))})"
            "(document.getElementById('scrub'))"
        )
        later = tab.picture()
        assert tab.run("viewer.state.frame") == 120
        assert "t = 2.41 s" in tab.run("document.getElementById('stamp').textContent")
        assert np.mean(np.any(np.abs(first - later) > 20, axis=2)) > 0.02
        tab.run("document.getElementById('wire').click()")
        edges = tab.picture()
        assert np.mean(np.any(np.abs(edges - later) > 20, axis=2)) > 0.02
        tab.run("document.getElementById('wire').click()")
        assert np.array_equal(tab.picture(), later)
        tab.run("viewer.camera.yaw += 1, viewer.show(120)")
        assert np.mean(np.any(np.abs(tab.picture() - later) > 20, axis=2)) > 0.02
        assert tab.errors == []
        assert set(tab.requests) == {file.as_uri()}
    assert 0.9 < np.ptp(wide) / np.ptp(high) < 1.1  # a ball is round


@chromium.needed
def test_a_browser_shows_colours_where_they_belong(wave, tmp_path):
    made = view.actor(wave, field=lambda problem, u: problem.mesh.points[:, 0])
    file = view.to_html(made, label="place [m]", limits=(0.0, 0.1)).save(tmp_path / "a.html")
    with chromium.tab() as tab:
        tab.call("Page.navigate", url=file.as_uri() + "#frame=2")
        tab.wait("Boolean(window.viewer && window.viewer.ready)")
        image = tab.picture()
        assert tab.run("document.getElementById('ticks').innerText").split()[0] == "0.1"
        assert tab.errors == [] and len(tab.requests) == 1
    body = np.flatnonzero(np.any(image[270, :700] < 230, axis=1))
    left, right = image[270, body[8]], image[270, body[-8]]
    assert left[2] > left[1] + 20 and right[1] > right[2] + 60  # violet, yellow
