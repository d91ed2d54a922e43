"""Markers and cameras against pictures with known answers."""

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2")

from sorojax import vision  # noqa: E402
from sorojax.cli.main import main  # noqa: E402
from sorojax.vision import BLUE, GREEN, RED, Camera, Discs, Disturbance, Pose  # noqa: E402

COLOURS = (RED, GREEN, BLUE)
NOISY = Disturbance()
QUIET = Disturbance(blur=0.8, noise=0.0)
CAMERA = Camera(608.0, 608.0, 319.5, 239.5)


@pytest.fixture(autouse=True)
def one_thread():
    cv2.setNumThreads(1)


def five_discs(random, width=640, height=480):
    centres = []
    while len(centres) < 5:
        one = random.uniform((40, 40), (width - 40, height - 40))
        if all(np.hypot(*(one - other)) > 60 for other in centres):
            centres.append(one)
    return Discs(np.array(centres), random.uniform(9, 16, 5), np.arange(5) % 3)


def picture_of(discs, random, disturbance=NOISY, width=640, height=480):
    canvas = vision.background(width, height)
    return vision.photograph(vision.draw_discs(canvas, *discs), disturbance, random)


def errors(found, true):
    """Distance of each true disc to the nearest one found of its colour [px]."""
    gap = np.linalg.norm(found.centre[None] - true.centre[:, None], axis=2)
    gap = np.where(found.colour[None] == true.colour[:, None], gap, np.inf)
    return gap.min(axis=1)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(("disturbance", "bar"), [(QUIET, 0.02), (Disturbance(), 0.03)])
def test_discs_to_a_fraction_of_a_pixel(disturbance, bar):
    random = np.random.default_rng(0)
    found = []
    for _ in range(8):
        true = five_discs(random)
        discs = vision.find_discs(picture_of(true, random, disturbance), COLOURS)
        assert len(discs.radius) == 5
        found.append(errors(discs, true))
    assert rms(found) < bar


def test_the_hough_way_and_its_refinement():
    random = np.random.default_rng(1)
    rough, fine = [], []
    for _ in range(4):
        true = five_discs(random)
        image = picture_of(true, random)
        rough.append(errors(vision.hough_discs(image, COLOURS), true))
        fine.append(errors(vision.hough_discs(image, COLOURS, refine=True), true))
    assert 0.03 < rms(rough) < 1.0 and rms(fine) < 0.03


@pytest.mark.parametrize("level", [0, 255])
@pytest.mark.stress(54)
def test_an_empty_picture_has_no_discs(level):
    image = np.full((120, 160, 3), level, np.uint8)
    assert len(vision.find_discs(image, COLOURS).radius) == 0
    assert len(vision.hough_discs(image, COLOURS).radius) == 0
    assert len(vision.find_fiducials(image).ids) == 0


@pytest.mark.stress(54)
def test_two_hundred_discs_are_all_found():
    random = np.random.default_rng(2)
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(10)), axis=-1).reshape(-1, 2)
    true = Discs(
        24.0 + 30 * grid + random.uniform(-2, 2, (200, 2)),
        np.full(200, 8.0),
        np.arange(200) % 3,
    )
    discs = vision.find_discs(picture_of(true, random), COLOURS)
    assert len(discs.radius) == 200 and errors(discs, true).max() < 0.2


def test_tracks_keep_their_identity_through_a_crossing_and_a_hiding():
    """Two red discs pass each other; one is hidden for five frames."""
    random = np.random.default_rng(3)
    tracks, found, hidden = None, [], range(20, 25)
    for k in range(40):
        centres = np.array([[100.0 + 8 * k, 200.0], [420.0 - 8 * k, 232.0], [300.0, 400.0]])
        true = Discs(centres, np.full(3, 12.0), np.array([0, 0, 1]))
        shown = true if k not in hidden else Discs(*(part[[0, 1]] for part in true))
        image = picture_of(shown, random)
        if tracks is None:
            tracks = vision.start_tracks(true._replace(centre=centres + 1.0))
        tracks = vision.follow(image, tracks, COLOURS)
        found.append(np.linalg.norm(tracks.discs.centre - centres, axis=1))
        if k in hidden:
            assert tracks.unseen[2] == k - 19 and tracks.stale[2] == (k >= 22)
    found = np.array(found)
    assert np.max(found[:, :2]) < 0.1 and np.max(found[30:]) < 0.1
    assert not np.any(tracks.unseen)


def test_a_track_that_jumps_is_found_again():
    random = np.random.default_rng(4)
    first = five_discs(random)
    tracks = vision.start_tracks(first)
    second = first._replace(centre=np.clip(first.centre + 37.0, 40, 440))
    tracks = vision.follow(picture_of(second, random), tracks, COLOURS)
    assert np.max(np.linalg.norm(tracks.discs.centre - second.centre, axis=1)) < 0.1


def markers_at(random, camera, size=0.05):
    """Four tilted markers about 0.45 m away and their picture."""
    canvas, poses = vision.background(camera.width, camera.height), {}
    for number in range(4):
        turn = cv2.Rodrigues(random.uniform(-0.5, 0.5, 3))[0] @ np.diag([1.0, -1, -1])
        side = np.array([2 * (number % 2) - 1, 2 * (number // 2) - 1])
        place = [
            *(side * (0.09, 0.06) + random.uniform(-0.01, 0.01, 2)),
            random.uniform(0.4, 0.5),
        ]
        poses[number] = Pose(turn, np.array(place))
        picture = vision.fiducial_picture(number)
        canvas = vision.draw_plane(canvas, camera, poses[number], picture, (1.25 * size,) * 2)
    return vision.photograph(canvas, Disturbance(0.7, 3.0), random), poses


@pytest.mark.versions
def test_fiducials_and_their_poses():
    random = np.random.default_rng(5)
    off, away, turned = [], [], []
    for _ in range(6):
        image, poses = markers_at(random, CAMERA)
        found = vision.find_fiducials(image)
        assert found.ids.tolist() == [0, 1, 2, 3]
        for number, corners in zip(found.ids, found.corners, strict=True):
            true = poses[int(number)]
            pixels = vision.project(CAMERA, true.apply(vision.marker_corners(0.05)))
            off.append(np.linalg.norm(corners - pixels, axis=1))
            pose = vision.marker_pose(CAMERA, corners, 0.05)
            away.append(np.linalg.norm(pose.translation - true.translation))
            turn = cv2.Rodrigues(pose.rotation.T @ true.rotation)[0]
            turned.append(np.rad2deg(np.linalg.norm(turn)))
    assert rms(off) < 0.05 and np.median(away) < 1e-4 and np.median(turned) < 0.1


def test_a_mirrored_marker_is_none():
    image = np.kron(vision.fiducial_picture(3), np.ones((20, 20), np.uint8))
    assert vision.find_fiducials(image).ids.tolist() == [3]
    assert len(vision.find_fiducials(np.ascontiguousarray(image[:, ::-1])).ids) == 0
    with pytest.raises(ValueError, match="need one of .*6X6_250"):
        vision.find_fiducials(image, "7x9")


def test_the_world_frame_from_four_markers():
    random = np.random.default_rng(6)
    distorted = CAMERA._replace(distortion=(0.08, -0.15, 1e-3, -5e-4, 0.05))
    tilt = cv2.Rodrigues(np.array([0.3, -0.2, 0.1]))[0] @ np.diag([1.0, -1, -1])
    world = Pose(tilt, np.array([0.01, -0.02, 0.5]))
    canvas, places = vision.background(640, 480), {}
    for number, (x, y) in enumerate(((-0.1, -0.07), (0.1, -0.07), (-0.1, 0.07), (0.1, 0.07))):
        shift = np.array([x, y, 0.0])
        places[number] = vision.marker_corners(0.05) + shift
        local = Pose(world.rotation, world.apply(shift))
        picture = vision.fiducial_picture(number)
        canvas = vision.draw_plane(canvas, distorted, local, picture, (0.0625, 0.0625))
    image = vision.photograph(canvas, Disturbance(0.7, 3.0), random)
    found = vision.world_frame(distorted, vision.find_fiducials(image), places)
    assert np.allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.norm(found.translation - world.translation) < 2e-4
    pixels = vision.project(distorted, found.apply(np.array([0.03, 0.02, 0.0])))
    true = vision.project(distorted, world.apply(np.array([0.03, 0.02, 0.0])))
    assert np.linalg.norm(pixels - true) < 0.05
    with pytest.raises(ValueError, match="need one of \\[17\\]"):
        vision.world_frame(CAMERA, vision.find_fiducials(image), {17: places[0]})


@pytest.mark.versions
def test_pixels_and_points():
    camera = Camera(600.0, 600.0, 319.5, 239.5)
    point = vision.deproject(camera, np.array([400.25, 300.75]), np.array(0.5))
    assert np.allclose(point, [0.067291667, 0.051041667, 0.5], atol=1e-9)
    bent = camera._replace(distortion=(0.1, -0.2, 1e-3, 2e-3, 0.05))
    pixels = np.random.default_rng(7).uniform((0, 0), (640, 480), (200, 2))
    for lens in (camera, bent):
        points = vision.deproject(lens, pixels, np.full(200, 0.6))
        assert np.max(np.abs(vision.project(lens, points) - pixels)) < 1e-9
    true = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), bent.matrix, np.array(bent.distortion)
    )[0]
    assert np.max(np.abs(true[:, 0] - pixels)) < 1e-9
    assert np.all(np.isnan(vision.deproject(camera, pixels[:2], np.array([0.0, -1.0]))))
    assert np.all(np.isnan(vision.project(camera, np.array([0.1, 0.1, -1.0]))))


@pytest.mark.stress(54)
def test_rays_end_on_a_plane_before_the_camera():
    lens = Camera(610.0, 605.0, 320.0, 240.0, (0.1, -0.05, 1e-3, -2e-3, 0.01))
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    turn = np.diag([1.0, -1.0, -1.0]) @ (np.eye(3) + 0.1 * (turn - turn.T))
    plane = Pose(np.linalg.qr(turn)[0], np.array([0.02, -0.01, 0.6]))
    places = np.random.default_rng(1).uniform(-0.1, 0.1, (50, 2))
    seen = plane.apply(np.concatenate([places, np.full((50, 1), 0.02)], axis=1))
    found = vision.on_plane(lens, vision.project(lens, seen), plane, height=0.02)
    np.testing.assert_allclose(found, places, atol=1e-12)
    heights = np.linspace(0.0, 0.04, 50)
    seen = plane.apply(np.concatenate([places, heights[:, None]], axis=1))
    found = vision.on_plane(lens, vision.project(lens, seen), plane, heights)
    np.testing.assert_allclose(found, places, atol=1e-12)
    behind = Pose(plane.rotation, -plane.translation)
    along = Pose(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([0.1, 0.0, 0.0]))
    for other in (behind, along):
        assert np.all(np.isnan(vision.on_plane(lens, np.array([[320.0, 240.0]]), other)))


def test_depth_of_a_marker_ignores_holes():
    depth = np.full((20, 30), 0.8)
    depth[8:11, 10:13] = 0.0
    depth[5:7] = np.nan
    at = np.array([[11.0, 9.0], [0.0, 0.0], [29.4, 19.4]])
    assert np.allclose(vision.depth_at(depth, at), 0.8)
    assert vision.depth_at(np.zeros((9, 9)), np.array([[4.0, 4.0]])) == [0.0]


def test_calibration_finds_the_camera_that_took_the_pictures(tmp_path):
    random = np.random.default_rng(8)
    true = Camera(370.0, 373.0, 163.0, 118.0, (0.06, -0.1, 8e-4, -6e-4, 0.0), 320, 240)
    board = vision.CharucoBoard()
    size = (board.columns * board.square, board.rows * board.square)
    picture, images = board.picture(2000.0), []
    for k in range(10):
        tilt = 0.45 * np.array([np.cos(0.63 * k), np.sin(0.63 * k), 0.3 * np.sin(k)])
        turn = cv2.Rodrigues(tilt)[0] @ np.diag([1.0, -1, -1])
        aside = 0.03 * np.array([np.cos(2.1 * k), np.sin(2.1 * k)])
        pose = Pose(turn, np.array([*aside, 0.34 + 0.01 * (k % 4)]))
        canvas = vision.draw_plane(vision.background(320, 240), true, pose, picture, size, 3)
        images.append(vision.photograph(canvas, Disturbance(0.6, 2.0), random))
    found = vision.calibrate(images, board)
    assert abs(found.fx / true.fx - 1) < 2e-3 and abs(found.fy / true.fy - 1) < 2e-3
    assert abs(found.cx - true.cx) < 1.0 and abs(found.cy - true.cy) < 1.0 and found.rms < 0.3
    vision.save_camera(tmp_path / "camera.json", found)
    assert vision.load_camera(tmp_path / "camera.json") == found
    files = [tmp_path / f"{k}.png" for k in range(10)]
    assert all(cv2.imwrite(str(f), image) for f, image in zip(files, images, strict=True))
    told = ["calibrate", *map(str, files), "--out", str(tmp_path / "by_command.json")]
    assert main(told) == 0
    same = vision.load_camera(tmp_path / "by_command.json")
    assert abs(same.fx / true.fx - 1) < 2e-3 and abs(same.fy / true.fy - 1) < 2e-3
    assert (same.width, same.height) == (320, 240)
    with pytest.raises(ValueError, match="0 pictures"):
        vision.calibrate([np.zeros((48, 64), np.uint8)] * 6, board)


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"fx": -1, "fy": 1, "cx": 0, "cy": 0}'])
@pytest.mark.stress(54)
def test_a_broken_calibration_is_refused(tmp_path, text):
    (tmp_path / "camera.json").write_text(text)
    with pytest.raises(ValueError, match="holds no camera"):
        vision.load_camera(tmp_path / "camera.json")
