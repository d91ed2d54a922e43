"""Films move, files are shown, and both say what they cannot do."""

import importlib.util
import io

import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import (
    _progress,
    fem,
    io as files,
    material,
    mesh as M,
    rod as R,
    sdf,
    systems,
    view,
)
from sorojax.cli.main import main
from sorojax.fem.equilibrium.solve import Path
from sorojax.fem.stability.modal import Modes
from sorojax.math.lie import SE2, SE3
from sorojax.math.status import Status
from sorojax.rod.dynamics.rollout import Trajectory
from sorojax.view.film.tracks import positions_track, track_of
from sorojax.view.raster.scene import Surface

LENGTH = 0.06


@pytest.fixture(scope="module")
def beam():
    return M.rectangle([0.0, -0.005], [LENGTH, 0.005], divisions=(6, 1))


@pytest.fixture(scope="module")
def path(beam):
    problem = fem.problem(
        beam,
        material.neo_hookean(young_modulus=1e5, poisson_ratio=0.3, density=1e3),
        kinematics=fem.PlaneStrain(0.02),
        supports=(fem.Fixed(M.nodes_where(beam, lambda p: p[0] < 1e-9)),),
        loads=(fem.Gravity([0.0, -9.81]),),
        formulation=fem.Displacement(),
    )
    x = np.asarray(beam.points)[:, 0]
    shapes = [np.stack([0 * x, -k * 0.005 * (x / LENGTH) ** 2], axis=1) for k in range(5)]
    pulls = jnp.zeros((5, 2)).at[:, 1].set(-9.81 * jnp.arange(5.0) / 4)
    return Path(problem, jnp.asarray(np.stack(shapes)), pulls, "gravity", Status.successful, ())


def triangle_at(place, dim=3):
    """A triangle whose corner is at x = place."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]])
    points[:, 0] += place
    return view.Scene(
        (
            Surface(
                points[:, :3] if dim == 3 else points[:, [0, 2]],
                np.array([[0, 1, 2]]),
                "#0072B2",
            ),
        )
    )


def track(dim=3, count=11, last=1.0):
    time = np.linspace(0.0, last, count)
    return view.Track(time, lambda k: triangle_at(2.0 * time[k], dim))


def blue(frame):
    image = frame.astype(int)
    return (image[:, :, 2] - image[:, :, 0]) > 40


def middle(frame):
    """Mean column of what is blue."""
    return np.flatnonzero(blue(frame).any(axis=0)).mean()


@pytest.mark.parametrize("dim", [2, 3])
def test_a_film_moves_and_stands_still_where_nothing_does(dim):
    film = view.animate(track(dim), fps=10, view="front", renderer="own", size=(320, 240))
    assert (film.frames, film.fps) == (11, 10) and "1.1 s" in repr(film)
    frames = [film.draw(k) for k in (0, 5, 10)]
    assert frames[0].shape == (240, 320, 3) and frames[0].dtype == np.uint8
    places = [middle(frame) for frame in frames]
    assert places[1] - places[0] > 40 and np.isclose(
        places[2] - places[1], places[1] - places[0], atol=3
    )
    changed = np.any(frames[0] != frames[2], axis=2)
    assert 0.01 < changed.mean() < 0.5
    assert np.array_equal(film.draw(5), frames[1])  # whatever was drawn before


def test_slow_motion_and_stamp():
    slow = view.animate(track(), fps=10, speed=0.1, renderer="own", size=(160, 120))
    assert slow.frames == 101
    plain = view.animate(track(), fps=10, renderer="own", stamp=False, size=(160, 120))
    stamped = view.animate(track(), fps=10, renderer="own", size=(160, 120))
    added = np.any(stamped.draw(3) != plain.draw(3), axis=2)
    assert added[:24, :80].sum() > 20 and not added[24:].any() and not added[:, 80:].any()
    with pytest.raises(ValueError, match="positive speed"):
        view.animate(track(), speed=0.0)
    with pytest.raises(TypeError, match="got a float, need a Trajectory"):
        view.animate(1.0)


def test_bodies_of_a_film_throw_shadows():
    def scene(k):
        ball = view.scene_of(sdf.Sphere([0, 0, 0.02], 0.01))
        return view.merge_scenes(ball, view.scene_of(sdf.Box([-0.05] * 3, [0.05, 0.05, 0])))

    still = view.Track(np.arange(2.0), scene)
    look = {"renderer": "own", "size": (160, 120), "stamp": False}
    lit, shaded = (view.animate(still, shadows=x, **look).draw(0) for x in (False, True))
    darker = np.any(shaded.astype(int) < lit.astype(int) - 30, axis=2)
    assert 0.002 < darker.mean() < 0.2 and not np.any(shaded > lit.astype(int) + 2)


@pytest.mark.parametrize("dim", [2, 3])
def test_two_results_side_by_side_at_the_same_instants(dim):
    wide = {"size": (400, 200), "view": "front", "renderer": "own"}
    slower = view.Track(np.linspace(0, 1, 3), lambda k: triangle_at(1.0 * k, dim))
    film = view.animate(
        track(dim), beside=slower, names=("measured", "simulated"), fps=10, **wide
    )
    frame = blue(film.draw(10))
    halves = (frame[:, :200], frame[:, 200:]) if dim == 3 else (frame[:100], frame[100:])
    assert all(half.sum() > 50 for half in halves)
    if dim == 3:  # both show x = 2 at the end, at one scale
        left, right = (np.flatnonzero(half[:, 100:].any(axis=0)) for half in halves)
        assert abs(left.mean() - right.mean()) < 10 and abs(len(left) - len(right)) < 3


def test_a_camera_that_moves():
    still = view.Track(np.linspace(0, 1, 5), lambda k: triangle_at(0.0))
    film = view.animate(
        still, view=view.orbit("front", turns=0.25), fps=4, renderer="own", size=(160, 120)
    )
    widths = [np.flatnonzero(blue(film.draw(k)).any(axis=0)).size for k in (0, 2)]
    edge = np.flatnonzero(np.any(film.draw(4) < 200, axis=(0, 2))).size
    assert widths[0] > widths[1] and edge < film.draw(4).shape[1]


def test_a_path_without_time_takes_three_seconds(path):
    film = view.animate(path, field="displacement", fps=5, size=(320, 200))
    assert film.frames == 16
    ends = film.draw(0), film.draw(15)
    yellow = [np.sum((f[:, :200, 0] > 180) & (f[:, :200, 2] < 100)) for f in ends]
    assert yellow[0] < 5  # no displacement at the start; the bar stands to the right
    assert np.mean(np.any(ends[0] != ends[1], axis=2)) > 0.01


def test_a_rod_and_a_mode_and_moved_nodes_are_filmed(beam, path):
    arm = R.rod(
        SE3(),
        R.chebyshev(kappa_y=1),
        R.circle(0.008),
        length=0.12,
        young_modulus=1e5,
        poisson_ratio=0.4,
        density=1e3,
    )
    run = Trajectory(
        jnp.linspace(0, 1, 5),
        jnp.linspace(0, 10, 5)[:, None],
        jnp.zeros((5, 1)),
        Status.successful,
    )
    film = view.animate(run, model=arm, fps=4, renderer="own", view="front", size=(200, 150))
    low = [
        np.flatnonzero(np.any(film.draw(k)[20:, 60:] < 200, axis=(1, 2))).max() for k in (0, 4)
    ]
    assert film.frames == 5 and low[0] != low[1]
    with pytest.raises(ValueError, match="Pass model="):
        view.animate(run)
    modes = Modes(
        path.problem, 0 * path.displacements[0], jnp.array([400.0]), path.displacements[-1:]
    )
    swing = view.animate(modes, fps=8, size=(200, 150))
    assert swing.frames == 17 and not np.array_equal(swing.draw(2), swing.draw(6))
    moved = np.asarray(beam.points)[None] + np.asarray(path.displacements)
    time = np.linspace(0, 1, 5)
    skin = view.animate(positions_track(beam, moved, time), fps=4, size=(200, 150))
    assert np.mean(np.any(skin.draw(0) != skin.draw(4), axis=2)) > 0.01


def test_a_film_is_written_as_gif_and_pictures(tmp_path):
    from PIL import Image

    seen = []
    film = view.animate(track(count=5), fps=4, renderer="own", size=(160, 120))
    with _progress.listen(seen.append):
        gif = Image.open(film.save(tmp_path / "a.gif"))
        film.save(tmp_path / "frames")
    assert (gif.n_frames, gif.size, gif.info["duration"]) == (5, (160, 120), 250)
    written = sorted((tmp_path / "frames").iterdir())
    assert [file.name for file in written][:2] == ["frame_0000.png", "frame_0001.png"]
    assert np.array_equal(np.asarray(Image.open(written[3])), film.draw(3))
    assert [p.done for p in seen] == [1, 2, 3, 4, 5] * 2 and seen[-1].label == "film"
    assert film._repr_html_().startswith('<img src="data:image/gif')
    assert Image.open(io.BytesIO(film._repr_png_())).size == (160, 120)
    fast = view.animate(track(count=101), fps=100, renderer="own", size=(160, 120))
    assert Image.open(io.BytesIO(fast.gif)).n_frames == 51  # every second of 101
    webp = Image.open(film.save(tmp_path / "a.webp"))
    assert (webp.n_frames, webp.size) == (5, (160, 120))
    webp.seek(3)
    off = np.asarray(webp.convert("RGB")).astype(int) - film.draw(3)
    assert np.abs(off).mean() < 3 and webp.info["timestamp"] == 3 * 250
    with pytest.raises(ValueError, match="need .webp, .gif, .mp4"):
        film.save(tmp_path / "a.doc")


def test_mp4_needs_its_extra(tmp_path, monkeypatch):
    film = view.animate(track(count=3), fps=4, renderer="own", size=(161, 121))
    if importlib.util.find_spec("imageio_ffmpeg") is not None:
        data = film.save(tmp_path / "a.mp4").read_bytes()
        assert data[4:8] == b"ftyp" and len(data) > 500
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match="needs imageio-ffmpeg"):
        film.save(tmp_path / "a.mp4")


def ink(file):
    from PIL import Image

    image = np.asarray(Image.open(file).convert("RGB")).astype(int)
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    assert np.all(border > 245)
    return np.mean(np.any(image < 250, axis=2))


@pytest.mark.filterwarnings("ignore:view. pyvista")
def test_the_command_shows_files(tmp_path, path, monkeypatch, capsys):
    monkeypatch.setattr("sorojax.cli.main._start_jax", lambda: None)
    monkeypatch.delenv("SOROJAX_DEBUG", raising=False)
    ball = sdf.isosurface(sdf.Sphere([0.0, 0.0, 0.0], 0.01), 0.004)
    files.export_surface(tmp_path / "ball.stl", ball)
    problem, u = path.problem, path.displacements
    files.export_fields(tmp_path / "run.pvd", problem, np.asarray(u), fields=("reaction",))
    files.export_fields(tmp_path / "one.vtu", problem, np.asarray(u[-1]), fields=())
    films = {"time": jnp.linspace(0, 1, 5), "outputs": {"a.b": jnp.arange(5.0)}}
    files.save(tmp_path / "run.npz", films)
    for name in ("ball.stl", "one.vtu", "run.pvd", "run.npz"):
        out = tmp_path / f"{name}.png"
        assert main(["show", str(tmp_path / name), "--out", str(out), "--wire"]) == 0
        assert capsys.readouterr().out == f"wrote {out}\n" and ink(out) > 0.02
    gif = tmp_path / "run.gif"
    assert main(["show", str(tmp_path / "run.pvd"), "--out", str(gif)]) == 0
    assert gif.stat().st_size > 3000
    assert main(["show", str(tmp_path / "one.vtu"), "--field", "heat"]) == 2
    assert "no field 'heat', it has displacement" in capsys.readouterr().err
    assert main(["show", str(tmp_path / "ball.stl"), "--out", str(gif)]) == 2
    files.save(tmp_path / "still.npz", {"a": jnp.zeros(3)})
    assert main(["show", str(tmp_path / "still.npz")]) == 2
    assert "or a time to draw over" in capsys.readouterr().err
    (tmp_path / "bad.pvd").write_text("<VTKFile>")
    assert main(["show", str(tmp_path / "bad.pvd")]) == 2


def swung(rod, qs):
    """A trajectory of a network with that rod, as `simulate` returns it."""
    body = systems.Network({"body": systems.RodBody(rod)}, {})
    time = jnp.linspace(0.0, 1.0, len(qs))
    stats = {"steps": jnp.asarray(1), "rejected": jnp.asarray(0), "reached": time[-1]}
    state = {"body": {"q": jnp.asarray(qs), "v": 0 * jnp.asarray(qs)}}
    return body, systems.Trajectory(time, state, {}, Status.successful, stats)


@pytest.mark.parametrize("drawn", ["mesh", "shape"])
def test_a_trajectory_carries_a_skin(beam, drawn):
    """The skin starts where the rod does, lies along it, and bends to its curvature."""
    rod = R.rod(
        SE2(),
        R.chebyshev(kappa_z=1),
        R.rectangle(0.01, 0.02),
        length=LENGTH,
        young_modulus=1e5,
        poisson_ratio=0.4,
        density=1e3,
    )
    kappa = np.pi / 2 / LENGTH
    network, film = swung(rod, [[0.0], [kappa / 2], [kappa]])
    skin = beam if drawn == "mesh" else sdf.Rectangle([0.0, -0.005], [LENGTH, 0.005])
    made = track_of(film, network=network, skin=skin)
    first, last = (made.scene(k).parts[0].points for k in (0, 2))
    rest = np.asarray(beam.points) if drawn == "mesh" else first
    assert np.allclose(first, rest, rtol=0, atol=1e-12)
    x, y = rest.T
    angle = kappa * x
    arc = np.stack(
        [(1 / kappa - y) * np.sin(angle), 1 / kappa - (1 / kappa - y) * np.cos(angle)], axis=1
    )
    assert np.allclose(last, arc, rtol=0, atol=1e-4 * LENGTH)
    shown = view.animate(film, network=network, skin=skin, fps=2, size=(200, 150))
    assert shown.frames == 3
    assert np.mean(np.any(shown.draw(0) != shown.draw(2), axis=2)) > 0.01


def test_a_trajectory_needs_to_know_what_moved(beam):
    rod = R.rod(
        SE2(),
        R.chebyshev(kappa_z=1),
        R.rectangle(0.01, 0.02),
        length=LENGTH,
        young_modulus=1e5,
        poisson_ratio=0.4,
        density=1e3,
    )
    network, film = swung(rod, [[0.0], [1.0]])
    with pytest.raises(ValueError, match="Pass network="):
        view.animate(film)
    with pytest.raises(ValueError, match="the bodies body"):
        view.animate(film, network=network, block="arm")


def test_the_stamp_stays_clear_of_the_names():
    wire = R.rod(
        SE3(), R.chebyshev(kappa_z=2), R.circle(2e-3), length=0.1, young_modulus=1e6,
        poisson_ratio=0.5, density=1000,
    )  # fmt: skip
    threads = R.Tendons([R.Straight([5e-3, 0.0]), R.Straight([-5e-3, 0.0])])
    body = systems.RodBody(wire, (R.Gravity(), R.Damping(0.05), threads))
    network = systems.Network({"body": body}, {}, exposed=("body.tension",))
    run = systems.simulate(network, 0.2, save=5, inputs={"body.tension": [0.1, 0.0]})
    look = {"network": network, "fps": 10, "renderer": "own", "size": (320, 240)}
    plain = view.animate(run, stamp=False, **look).draw(1)
    added = np.any(view.animate(run, **look).draw(1) != plain, axis=2)
    assert (plain[:24, :160] < 128).any()  # names
    assert added.any() and (plain[added] > 240).all()  # the stamp is on blank paper
