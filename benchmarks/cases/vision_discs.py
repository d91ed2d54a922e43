"""Coloured discs in noisy pictures: error of the centres and pictures a second."""

from time import process_time

import numpy as np

from benchmarks.harness import Row, Timing
from sorojax import vision
from sorojax.vision import Discs, Disturbance
from sorojax.vision.camera import opencv

COLOURS = (vision.RED, vision.GREEN, vision.BLUE)
#: Method, bar on the time of a 1280 x 720 picture [s], bar on the error [px, rms].
METHODS = {"find": (1 / 180, 0.03), "follow": (1 / 1500, 0.03), "hough": (None, None)}


def rows():
    opencv().setNumThreads(1)
    for width, height in ((640, 480), (1280, 720)):
        random = np.random.default_rng(0)
        scenes = [_scene(random, width, height) for _ in range(30)]
        for method, (bar, bar_error) in METHODS.items():
            settings = {"method": method, "picture": f"{width} x {height}", "discs": 5}
            found, runs, missed = _run(method, scenes)
            error = float(np.sqrt(np.mean(np.square(found))))
            told = settings | {"rate": 1 / np.median(runs), "missed": missed}
            fast = bar if width == 1280 else None
            timing = Timing(0.0, tuple(runs)).columns()
            yield Row(
                "sorojax",
                told,
                **timing,
                error=error,
                bar=fast,
                reference="centres drawn, px rms; CPU time",
            )
            if bar_error is not None:
                yield Row(
                    "sorojax",
                    settings | {"what": "error"},
                    error=error,
                    bar=bar_error,
                    bar_on="error",
                    reference="centres drawn, px rms",
                )


def _scene(random, width, height):
    centres: list = []
    while len(centres) < 5:
        one = random.uniform((40, 40), (width - 40, height - 40))
        if all(np.hypot(*(one - other)) > 60 for other in centres):
            centres.append(one)
    discs = Discs(np.array(centres), random.uniform(9, 16, 5), np.arange(5) % 3)
    canvas = vision.draw_discs(vision.background(width, height), *discs)
    return vision.photograph(canvas, Disturbance(), random), discs


def _run(method: str, scenes):
    errors, runs, missed = [], [], 0
    for image, true in scenes:
        before = true._replace(centre=true.centre + 2.0)
        tracks = vision.start_tracks(before)
        start = process_time()
        if method == "follow":
            found = vision.follow(image, tracks, COLOURS).discs
        elif method == "find":
            found = vision.find_discs(image, COLOURS)
        else:
            found = vision.hough_discs(image, COLOURS)
        runs.append(process_time() - start)
        gap = np.linalg.norm(found.centre[None] - true.centre[:, None], axis=2)
        gap = np.where(found.colour[None] == true.colour[:, None], gap, np.inf).min(axis=1)
        missed += int(np.sum(gap > 3))
        errors += gap[gap <= 3].tolist()
    return errors, runs, missed
