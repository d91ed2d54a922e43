"""A robot drawn in space, seen in colour and depth: one estimator for every source."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

cv2 = pytest.importorskip("cv2")

from sorojax import rod as R, vision  # noqa: E402
from sorojax.math.lie import SE3  # noqa: E402
from sorojax.systems import Markers, estimate_shape  # noqa: E402
from sorojax.vision import Balls, Camera, Pose  # noqa: E402
from sorojax.vision.synthetic import PAINTS  # noqa: E402
from sorojax_hardware import DrawnCamera, FolderCamera, Latest, SimulatedClock  # noqa: E402

FINGER = dict(length=0.08, young_modulus=1e6, poisson_ratio=0.3, density=1100.0)
SPATIAL = R.rod(SE3(), R.chebyshev(kappa_y=2, kappa_z=2), R.circle(6e-3), nodes=6, **FINGER)
S = jnp.array([0.25, 0.5, 0.75, 1.0])
LENS = Camera(400.0, 400.0, 159.5, 119.5, (0.05, -0.1, 5e-4, -4e-4, 0.0), 320, 240)
COLOURS = (vision.RED, vision.GREEN, vision.BLUE)
PAINT, RADIUS, RATE = np.array([0, 1, 2, 0]), 4e-3, 30.0
FRAMES, HIDDEN = 12, range(5, 8)
# the finger grows to the right, 0.26 m in front of the lens; its y points up
LOOK = Pose(np.diag([1.0, -1.0, -1.0]), np.array([-0.04, 0.0, 0.26]))
OFFSET = jnp.array([[0.0, 0.0, 8e-3]] * 4)  # markers stand on the side that the lens sees


@jax.jit
def places(q):
    """Twelve places of the backbone, and the markers [m]."""
    poses = R.forward_kinematics(SPATIAL, q, S)
    on_skin = poses[:, :3, 3] + jnp.einsum("mij,mj->mi", poses[:, :3, :3], OFFSET)
    return R.forward_kinematics(SPATIAL, q, jnp.linspace(0, 1, 12))[:, :3, 3], on_skin


@jax.jit
def estimate(seen, q):
    return estimate_shape(Markers(SPATIAL, S, OFFSET), seen, q)


def shape_at(t):
    return jnp.array([6 * np.sin(5 * t), -3.0, 8 * np.cos(4 * t), 2.0])


def draw(t):
    """Body, markers, and from the fifth picture on for a while something before the third."""
    body, markers = (np.asarray(x) for x in places(shape_at(t)))
    centre, paint = np.concatenate([body, markers]), [-1] * len(body) + list(PAINT)
    radius = [6e-3] * len(body) + [RADIUS] * 4
    if round(t * RATE) in HIDDEN:
        centre = np.concatenate([centre, markers[2:3] + [0.0, 0.0, 0.05]])
        radius, paint = [*radius, 9e-3], [*paint, -1]
    balls = Balls(LOOK.apply(centre), np.array(radius), np.array(paint))
    colour, depth = vision.draw_balls(vision.background(320, 240), LENS, balls)
    random = np.random.default_rng(round(t * RATE))
    return vision.photograph(colour, vision.Disturbance(0.6, 3.0), random), depth


def watched(read):
    """Shapes and number of markers seen, picture by picture, of whatever `read` gives."""
    first = vision.project(LENS, LOOK.apply(np.asarray(places(shape_at(0.0))[1])))
    tracks = vision.start_tracks(vision.Discs(first, np.full(4, 6.5), PAINT))
    q, found = jnp.zeros(4), []
    while (image := read()) is not None:
        tracks = vision.follow(image.colour, tracks, COLOURS)
        pixels = np.where(tracks.unseen[:, None] > 0, np.nan, tracks.discs.centre)
        depth = vision.depth_at(image.depth, np.nan_to_num(pixels)) + RADIUS
        points = LOOK.inverse().apply(vision.deproject(LENS, pixels, depth))
        shape = estimate(jnp.asarray(points), q)
        q = shape.q
        found.append((int(shape.seen), np.asarray(q)))
    return found


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """A run with the drawn camera, and the folder where its pictures are kept."""
    clock, folder = SimulatedClock(), tmp_path_factory.mktemp("film")
    camera, count = DrawnCamera(draw, clock, rate=RATE), iter(range(FRAMES))

    def read():
        k = next(count, None)
        if k is None:
            return None
        clock.sleep_until(k / RATE)
        image = camera.read()
        assert image is not None
        cv2.imwrite(str(folder / f"{k:03d}.png"), image.colour)
        np.save(folder / f"{k:03d}.depth.npy", image.depth)
        return image

    return watched(read), folder


def test_the_tip_is_where_the_drawing_has_it(simulated):
    for k, (seen, q) in enumerate(simulated[0]):
        assert seen == (3 if k in HIDDEN else 4)
        off = np.asarray(places(q)[0] - places(shape_at(k / RATE))[0])[-1]
        assert np.linalg.norm(off) < (3e-3 if k in HIDDEN or k == 0 else 1e-3), (k, off)


def test_a_recorded_run_gives_the_bits_of_the_simulated_one(simulated):
    run, folder = simulated
    again = watched(FolderCamera(folder, rate=RATE).read)
    assert len(again) == FRAMES
    assert all(
        a == b and np.array_equal(p, q) for (a, p), (b, q) in zip(run, again, strict=True)
    )


def test_so_does_a_camera_read_by_a_thread(simulated):
    clock, count = SimulatedClock(), iter(range(FRAMES))
    camera = Latest(DrawnCamera(draw, clock, rate=RATE))

    def read():
        k = next(count, None)
        if k is None:
            return None
        clock.sleep_until(k / RATE)
        start = time.monotonic()
        while (image := camera.read()) is None:
            assert time.monotonic() - start < 10
            time.sleep(1e-3)
        return image

    live = watched(read)
    camera.close()
    assert camera.dropped == 0
    assert all(np.array_equal(p, q) for (_, p), (_, q) in zip(simulated[0], live, strict=True))


def test_a_ball_is_as_large_and_as_far_as_it_should_be():
    lens = LENS._replace(distortion=(0.0,) * 5)
    centre, radius = np.array([[0.03, -0.02, 0.2], [0.03, -0.02, 0.4]]), np.array([5e-3, 9e-3])
    balls = Balls(centre, radius, np.array([1, 0]))
    picture, depth = vision.draw_balls(np.zeros((240, 320, 3)), lens, balls, fine=8)
    cover = picture[:, 205:, 1] / PAINTS[1][1]  # of the near one alone
    # the outline is the ellipse in which the plane z = 1 cuts the cone of the ball
    x, y, z = centre[0]
    square = z * z - radius[0] ** 2
    area = np.pi * radius[0] ** 2 * np.sqrt(square + x * x + y * y) / square**1.5
    assert cover.sum() == pytest.approx(area * 400**2, rel=2e-3)
    row, column = (int(np.rint(v)) for v in vision.project(lens, centre[0])[::-1])
    ray = np.array([x, y, z]) / np.linalg.norm(centre[0])
    assert depth[row, column] == pytest.approx(z - radius[0] * ray[2], abs=2e-5)
    assert depth[0, 0] == 0 and np.count_nonzero(depth) > 300
    behind = Balls(centre * [1, 1, -1], radius, np.array([1, 0]))
    assert not np.any(vision.draw_balls(np.zeros((240, 320, 3)), lens, behind)[0])
