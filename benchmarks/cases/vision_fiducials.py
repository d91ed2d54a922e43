"""ArUco markers in noisy pictures: corners, poses, time; OpenCV's own refinement beside."""

from time import process_time

import numpy as np

from benchmarks.harness import Row, Timing
from sorojax import vision
from sorojax.vision import Camera, Disturbance, Pose
from sorojax.vision.camera import opencv
from sorojax.vision.fiducials import Fiducials

SIZE, PICTURES = 0.05, 20
BARS = {"corner, px rms": 0.05, "place, m median": 1e-4}


def rows():
    cv2 = opencv()
    cv2.setNumThreads(1)
    for width, height in ((640, 480), (1280, 720)):
        camera = Camera(
            0.95 * width,
            0.95 * width,
            width / 2 - 0.5,
            height / 2 - 0.5,
            width=width,
            height=height,
        )
        random = np.random.default_rng(0)
        scenes = [_scene(random, camera) for _ in range(PICTURES)]
        for code in ("sorojax", "opencv"):
            find = vision.find_fiducials if code == "sorojax" else _opencv_subpix
            found, runs = _run(find, camera, scenes)
            for what, error in found.items():
                settings = {"picture": f"{width} x {height}", "markers": 4, "what": what}
                bar = BARS[what] if code == "sorojax" and width == 640 else None
                timing = Timing(0.0, tuple(runs)).columns()
                yield Row(
                    code,
                    settings,
                    **timing,
                    error=error,
                    bar=bar,
                    bar_on="error",
                    reference="drawn at 0.4 to 0.5 m",
                )


def _scene(random, camera: Camera):
    cv2 = opencv()
    canvas, poses = vision.background(camera.width, camera.height), {}
    for number in range(4):
        turn = cv2.Rodrigues(random.uniform(-0.5, 0.5, 3))[0] @ np.diag([1.0, -1, -1])
        side = np.array([2 * (number % 2) - 1, 2 * (number // 2) - 1])
        aside = side * (0.09, 0.06) + random.uniform(-0.01, 0.01, 2)
        poses[number] = Pose(turn, np.array([*aside, random.uniform(0.4, 0.5)]))
        picture = vision.fiducial_picture(number)
        canvas = vision.draw_plane(
            canvas, camera, poses[number], picture, (1.25 * SIZE, 1.25 * SIZE), 8
        )
    return vision.photograph(canvas, Disturbance(0.7, 3.0), random), poses


def _opencv_subpix(image):
    aruco = opencv().aruco
    settings = aruco.DetectorParameters()
    settings.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    words = aruco.getPredefinedDictionary(aruco.DICT_6X6_250)
    corners, ids, _ = aruco.ArucoDetector(words, settings).detectMarkers(image)
    return Fiducials(ids.ravel(), np.array(corners, float).reshape(-1, 4, 2))


def _run(find, camera: Camera, scenes):
    corner, place, runs = [], [], []
    for image, poses in scenes:
        start = process_time()
        found = find(image)
        runs.append(process_time() - start)
        for number, corners in zip(found.ids, found.corners, strict=True):
            true = poses[int(number)]
            pixels = vision.project(camera, true.apply(vision.marker_corners(SIZE)))
            corner.append(np.linalg.norm(corners - pixels, axis=1))
            pose = vision.marker_pose(camera, corners, SIZE)
            place.append(np.linalg.norm(pose.translation - true.translation))
    rms = float(np.sqrt(np.mean(np.square(corner))))
    return {"corner, px rms": rms, "place, m median": float(np.median(place))}, runs
