"""Skinning: seconds per frame of 100,000 vertices on spatial rods, at 200 frames/s or more."""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, measure
from sorojax import view
from sorojax.math.lie import SE3, homogeneous
from sorojax.rod import Part, assembly, chebyshev, circle, forward_kinematics, rest, rod

LENGTH, RADIUS, VERTICES = 0.1, 0.005, 100_000
GAP = 0.012  # m between fingers, of which the outer tenths of each are shared
BAR = 1 / 200  # s
REFERENCE = "largest distance from the exact sections, relative to the length"


def finger():
    return rod(
        SE3(),
        chebyshev(kappa_x=1, kappa_y=3, kappa_z=3),
        circle(RADIUS),
        length=LENGTH,
        young_modulus=1e5,
        poisson_ratio=0.49,
        density=1e3,
    )


def cloud() -> tuple[np.ndarray, np.ndarray]:
    """Places along the rod and points around it."""
    rng = np.random.default_rng(0)
    s = rng.uniform(size=VERTICES)
    across = rng.uniform(-RADIUS, RADIUS, (VERTICES, 2))
    return s, np.column_stack([LENGTH * s, across])


def error(model, skin, q, s, points) -> float:
    poses = jax.jit(forward_kinematics)(model, q, jnp.asarray(s))
    local = jnp.asarray(points * np.array([0.0, 1.0, 1.0]))
    exact = jnp.einsum("pij,pj->pi", poses[:, :3, :3], local) + poses[:, :3, 3]
    return float(jnp.max(jnp.abs(view.deform(skin, model, q) - exact)) / LENGTH)


def single(tree):
    """The same in single precision."""
    return jax.tree.map(
        lambda x: x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree
    )


def rows():
    model, (s, points) = finger(), cloud()
    skin = view.bind(points, model)
    q = jnp.array([3.0, 8.0, -4.0, 12.0, 5.0, 0.1, 2.0])
    far = error(model, skin, q, s, points)
    for kind, args in (("float64", (skin, model, q)), ("float32", single((skin, model, q)))):
        timing = measure(view.deform, *args, repeats=50)
        settings = {"vertices": VERTICES, "parts": 1, "numbers": kind}
        yield Row(
            "sorojax",
            settings,
            **timing.columns(),
            error=far if kind == "float64" else None,
            reference=REFERENCE,
            bar=BAR,
        )
    hand = assembly(SE3(), **{f"finger_{k}": Part(model, offset=_at(k)) for k in range(3)})
    points = points + np.array([0.0, GAP, 0.0]) * (np.arange(VERTICES) % 3 - 1)[:, None]
    shared = view.bind(points, hand, blend=RADIUS)
    timing = measure(view.deform, shared, hand, rest(hand), repeats=50)
    settings = {
        "vertices": VERTICES,
        "parts": 3,
        "shared": int(jnp.sum(shared.more < shared.more.max())),
    }
    yield Row("sorojax", settings, **timing.columns(), bar=BAR)


def _at(k: int):
    return homogeneous(jnp.eye(3), jnp.array([0.0, GAP * (k - 1), 0.0]))
