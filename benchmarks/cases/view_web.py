"""A three-finger grasp as one page: 20k triangles, 200 frames; bytes, and seconds to write."""

import time

import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row
from sorojax import view
from sorojax.math.lie import SE3, homogeneous
from sorojax.rod import Part, assembly, chebyshev, circle, rod
from sorojax.sdf import Sphere, isosurface
from sorojax.view.web.actor import Actor

LENGTH, RADIUS, BALL = 0.12, 0.008, 0.035  # m
FRAMES, SECONDS = 200, 4.0
BAR = 12.0  # MB


def hand():
    """Three fingers that hang from z = 0 around a ball."""
    finger = rod(
        SE3(),
        chebyshev(kappa_y=3, kappa_z=2),
        circle(RADIUS),
        length=LENGTH,
        young_modulus=1e5,
        poisson_ratio=0.49,
        density=1e3,
    )
    parts = {}
    for k in range(3):
        turn = 2 * np.pi * k / 3
        out = np.array([np.cos(turn), np.sin(turn), 0.0])
        down = np.array([0.0, 0.0, -1.0])
        rotation = np.stack([down, np.cross(-out, down), -out], axis=1)
        pose = homogeneous(jnp.asarray(rotation), jnp.asarray(0.05 * out))
        parts[f"finger_{k}"] = Part(finger, offset=pose)
    return assembly(SE3(), **parts)


def closing(frames: int = FRAMES) -> np.ndarray:
    """Coordinates of a hand that opens, closes with a ringing, and lifts off again."""
    t = np.linspace(0, SECONDS, frames)
    close = np.clip(t, 0, 1.5) / 1.5
    ring = np.exp(-3 * np.clip(t - 1.5, 0, None)) * np.sin(25 * np.clip(t - 1.5, 0, None))
    bend = -9.0 * (close**2 * (3 - 2 * close) + 0.1 * ring)
    q = np.zeros((frames, 3, 5))
    for k in range(3):
        q[:, k, 0] = bend * (1 + 0.05 * k)
        q[:, k, 1] = -2.0 * close * np.sin(3 * t + k)
        q[:, k, 3] = 0.6 * np.sin(5 * t + 2 * k) * close
    return q.reshape(frames, -1)


def actors(around: int = 48, stations: int = 67, frames: int = FRAMES) -> list[Actor]:
    """The fingers, and a ball that rises once they hold it."""
    model = hand()
    fingers = view.rig(model, around=around, stations=stations)
    ball = isosurface(Sphere([0.0, 0.0, 0.0], BALL), BALL / 5)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    t = np.linspace(0, SECONDS, frames)
    poses[:, 2, 3] = -0.11 + 0.02 * np.clip(t - 2.5, 0, None)
    return [
        view.actor(fingers, q=closing(frames), colour="#c9d3df", name="fingers"),
        view.actor(ball, poses=poses, colour="#D55E00", name="ball"),
    ]


def rows():
    made = actors()
    triangles = sum(len(each.triangles) for each in made)
    start = time.perf_counter()
    page = view.to_html(*made, time=np.linspace(0, SECONDS, FRAMES), title="grasp")
    seconds = time.perf_counter() - start
    settings = {"triangles": triangles, "frames": FRAMES, "seconds_to_write": round(seconds, 2)}
    yield Row(
        "sorojax",
        settings,
        error=len(page.html.encode()) / 1e6,
        reference="MB of the file",
        bar=BAR,
        bar_on="error",
    )
