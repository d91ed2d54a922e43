"""A rod as a chain of straight segments: stretch of the segments, turning at the vertices.

The energy of a rod without shear, of axial stiffness EA and bending stiffness EI, is

    sum EA/2 (l / L - 1 + a)^2 L  +  sum EI/2 |k - k0|^2 D / C^2,

over segments of length l, at rest L, and vertices. Here a is a shortening, k = 2 tan(angle / 2)
the turning from one segment to the next, a vector in the section, C the length between the
middles of the two, and D the length that the vertex stands for: C, and at a free end half of
the last segment more, so that the error is of the second order whatever holds the end. A
clamped end is a vertex too, between the direction of the wall and the first segment, where
C = D is half of that segment.

Reference:
    Bergou, Wardetzky, Robinson, Audoly, Grinspun, "Discrete elastic rods", ACM Transactions
    on Graphics 27, 2008, for the turning of a vertex and its energy.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._jax.jit import once


class Stretch(NamedTuple):
    """Segments: their lengths at rest [m], the share that a group has of them, EA [N]."""

    rest: Float[Array, "*groups segments"]
    share: Float[Array, "*groups segments"]
    stiffness: Float[Array, "*groups"]


class Turn(NamedTuple):
    """A vertex: EI [N m^2], the length between the middles of its segments [m], the length
    that it stands for over that, and how it turns at rest."""

    stiffness: Float[Array, "*groups"]
    span: Float[Array, "*groups"]
    share: Float[Array, "*groups"]
    rest: Float[Array, "*groups turns"]


def norm(vector: Float[Array, "*points dim"]) -> Float[Array, "*points"]:
    return jnp.sqrt(jnp.sum(vector**2, axis=-1))


def strains(
    stretch: Stretch, ends: Float[Array, "points dim"], value: Float[Array, ""]
) -> Float[Array, " segments"]:
    """Strain of the segments beyond that of a rod shorter by `value` [-]."""
    return norm(ends[1:] - ends[:-1]) / stretch.rest - 1 + value


def stretch_energy(
    stretch: Stretch,
    ends: Float[Array, "points dim"],
    value: Float[Array, ""],
    tension_only: bool,
) -> Float[Array, ""]:
    """Energy of the segments [J]; without that of compression for a fibre that slackens."""
    strain = strains(stretch, ends, value)
    strain = jnp.where(strain > 0, strain, jnp.zeros_like(strain)) if tension_only else strain
    return 0.5 * stretch.stiffness * jnp.sum(stretch.share * stretch.rest * strain**2)


def turning(
    ends: Float[Array, "3 dim"], director: Float[Array, " dim"]
) -> Float[Array, " turns"]:
    """How the second segment turns from the first [-]: in space about the part of `director`
    across the rod and about the third axis, in the plane counter-clockwise."""
    first, second = ends[1] - ends[0], ends[2] - ends[1]
    both = norm(first) * norm(second) + jnp.sum(first * second)
    if ends.shape[1] == 2:
        return (2 * (first[0] * second[1] - first[1] * second[0]) / both)[None]
    about = 2 * jnp.cross(first, second) / both
    along = first / norm(first) + second / norm(second)
    along = along / norm(along)
    across = director - jnp.sum(director * along) * along
    across = across / norm(across)
    return jnp.stack([jnp.sum(about * across), jnp.sum(about * jnp.cross(along, across))])


def moment(
    turn: Turn, ends: Float[Array, "3 dim"], director: Float[Array, " dim"]
) -> Float[Array, " turns"]:
    """Bending moment at a vertex [N m]."""
    return turn.stiffness * (turning(ends, director) - turn.rest) / turn.span


def turn_energy(
    turn: Turn, ends: Float[Array, "3 dim"], director: Float[Array, " dim"]
) -> Float[Array, ""]:
    """Energy of a vertex [J]."""
    turned = jnp.sum((turning(ends, director) - turn.rest) ** 2)
    return 0.5 * turn.stiffness * turn.share / turn.span * turned


Ends = tuple[bool, bool]


def segment_shares(points: int, width: int, clamped: Ends) -> Float[np.ndarray, "groups pair"]:
    """Which part of its segments each group of `width` points in a row stands for: all of them
    for pairs; half for three, the whole of the last at a free end, none of the segment that
    leads out of the rod at a clamped one."""
    shares = np.full((points - width + 1, width - 1), 1.0 if width == 2 else 0.5)
    if width == 3:
        shares[0, 0], shares[-1, -1] = (0.0 if held else 1.0 for held in clamped)
    return shares


def spans(
    rest: Float[Array, "rods segments"], clamped: Ends
) -> tuple[Float[Array, "rods vertices"], Float[Array, "rods vertices"]]:
    """Of the vertices that turn, the length between the middles of their segments [m] and the
    length that they stand for over that."""
    half = rest / 2
    for end, held in zip((0, -1), clamped, strict=True):
        half = half.at[:, end].set(0.0) if held else half
    span = half[:, 1:] + half[:, :-1]
    own = span
    for end, held in zip((0, -1), clamped, strict=True):
        own = own if held else own.at[:, end].add(half[:, end])
    return span, own / span


@once
def resampled(
    points: Float[Array, "rods points dim"], count: int
) -> Float[Array, "rods count dim"]:
    """`count` points along polylines, evenly by length; differentiable in the points."""
    lengths = norm(points[:, 1:] - points[:, :-1])
    along = jnp.concatenate(
        [jnp.zeros_like(lengths[:, :1]), jnp.cumsum(lengths, axis=1)], axis=1
    )
    share = jnp.linspace(0.0, 1.0, count)
    rows = []
    for at, line in zip(along, points, strict=True):
        rows.append(
            jnp.stack([jnp.interp(share * at[-1], at, column) for column in line.T], axis=1)
        )
    return jnp.stack(rows)
