"""Things that robots are put together from: bodies in a ring, cylinders to hold."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.math.lie import homogeneous
from sorojax.rod import Link, Part, Rod


def ring(
    body: Rod | Link, count: int, radius: Float[Array, ""] | float, name: str = "finger"
) -> dict[str, Part]:
    """Copies of a body round the z axis, hanging from a circle in the plane z = 0.

    The local x axis of each points down and its y axis towards the axis of the ring, so that
    a positive curvature about z closes the ring like a hand.

    Args:
        body: A rod or a link in space.
        count: Number of copies.
        radius: Of the circle [m].
        name: The parts are called `name_0`, `name_1`, ...; the first is at x = `radius`.

    Returns:
        Parts for `rod.assembly(sj.SE3(), **parts)`.

    Raises:
        ValueError: If there is none, or the radius is not above zero.
    """
    if count < 1:
        raise ValueError(f"ring: got count={count}, need one or more. Give a whole number.")
    radius = real(radius)
    _check.positive("ring", "radius", radius, "m", "Lengths are in metres: write 30 * mm.")
    return {
        f"{name}_{k}": Part(body, offset=_hanging(2 * jnp.pi * k / count, radius))
        for k in range(count)
    }


def _hanging(angle: float, radius: Float[Array, ""]) -> Float[Array, "4 4"]:
    c, s = (f(jnp.asarray(angle, radius.dtype)) for f in (jnp.cos, jnp.sin))
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    turn = jnp.stack(
        [
            jnp.stack([zero, -c, -s]),
            jnp.stack([zero, -s, c]),
            jnp.stack([-one, zero, zero]),
        ]
    )  # fmt: skip
    return homogeneous(turn, radius * jnp.stack([c, s, zero]))


def below(depth: Float[Array, ""] | float) -> Float[Array, "4 4"]:
    """Pose of what hangs `depth` [m] below the middle of a ring, not turned."""
    depth = real(depth)
    zero = jnp.zeros_like(depth)
    return homogeneous(jnp.eye(3, dtype=depth.dtype), jnp.stack([zero, zero, -depth]))


def upside_down(height: Float[Array, ""] | float) -> Float[Array, "4 4"]:
    """Pose of what hangs from a beam at `height` [m], its z axis down, its x axis kept."""
    height = real(height)
    zero = jnp.zeros_like(height)
    turn = jnp.diag(jnp.asarray([1.0, -1.0, -1.0], height.dtype))
    return homogeneous(turn, jnp.stack([zero, zero, height]))


def cylinder(
    mass: Float[Array, ""] | float,
    radius: Float[Array, ""] | float,
    length: Float[Array, ""] | float,
) -> Link:
    """A homogeneous round cylinder about z, its frame in its middle.

    Args:
        mass: [kg].
        radius: [m].
        length: [m].
    """
    mass, radius, length = real(mass), real(radius), real(length)
    across = mass * (3 * radius**2 + length**2) / 12
    return Link(mass, jnp.stack([across, across, mass * radius**2 / 2]))


def rim(
    radius: float, height: float, count: int = 24
) -> tuple[Float[np.ndarray, "count 3"], Float[np.ndarray, " count"]]:
    """Points on an edge of a cylinder about z, and the length that each stands for [m]: where
    it touches what it stands on, for `rod.LinkObstacle`.

    Args:
        radius: [m].
        height: Of the edge in the frame of the cylinder [m].
        count: Number of points, three or more.
    """
    if count < 3 or not radius > 0:
        raise ValueError(
            f"rim: got {count} points on a radius of {radius} m, need three or more and a "
            "radius above zero. Give the radius of the cylinder in metres."
        )
    angle = 2 * np.pi * np.arange(count) / count
    ring = [radius * np.cos(angle), radius * np.sin(angle), np.full(count, float(height))]
    return np.stack(ring, axis=1), np.full(count, 2 * np.pi * radius / count)
