"""The strains of a material line of a solid: what a rod in its place would feel."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.fem.solve import Path
from sorojax.mesh.locate import Locations, locate


class AbstractCurve(eqx.Module):
    """A curve in the reference configuration, parametrised by s in [0, 1]."""

    @abc.abstractmethod
    def __call__(self, s: Float[Array, " points"]) -> Float[Array, "points dim"]:
        """Points [m]."""


class Line(AbstractCurve):
    """The straight line from `start` to `end` [m]."""

    start: Float[Array, "2"] = eqx.field(converter=real)
    end: Float[Array, "2"] = eqx.field(converter=real)

    def __check_init__(self):
        _check.shape("Line", "start", self.start, (2,), "Give (x, y) in metres.")
        _check.shape("Line", "end", self.end, (2,), "Give (x, y) in metres.")
        if _check.is_concrete(self.start) and np.allclose(self.start, self.end, rtol=0, atol=0):
            raise ValueError(
                f"Line: `start` and `end` are both {np.asarray(self.start)} m. Give two points."
            )

    def __call__(self, s):
        return self.start[None] + s[:, None] * (self.end - self.start)[None]


class Backbone(eqx.Module):
    """Snapshots of a line in the frame of its base: x along the line at rest.

    `strain` holds kappa_z [1/m], sigma_x and sigma_y [-] at the samples `s` in [0, 1].
    """

    s: Float[Array, " samples"]
    length: Float[Array, ""]
    positions: Float[Array, "steps samples 2"]
    strain: Float[Array, "steps samples 3"]


class Probe(eqx.Module):
    """Samples of a line in a mesh: takes a displacement field to line positions."""

    locations: Locations
    rest: Float[Array, "samples 2"]
    s: Float[Array, " samples"]

    @property
    def length(self) -> Float[Array, ""]:
        return jnp.sqrt(jnp.sum((self.rest[-1] - self.rest[0]) ** 2))

    def __call__(self, u: Float[Array, "nodes dim"]) -> Float[Array, "samples 2"]:
        """Positions of the line in the frame of its base [m]."""
        along = (self.rest[-1] - self.rest[0]) / self.length
        across = jnp.stack([-along[1], along[0]])
        moved = self.rest - self.rest[:1] + self.locations(u)
        return moved @ jnp.stack([along, across], axis=1)


def probe(mesh, line: Line, samples: int = 81) -> Probe:
    """Samples of `line` in `mesh`, equally spaced.

    Raises:
        ValueError: If the line leaves the mesh.
    """
    s = jnp.linspace(0.0, 1.0, samples)
    rest = line(s)
    return Probe(locate(mesh, np.asarray(rest)), rest, s)


def line_strain(
    positions: Float[Array, "samples 2"], length: Float[Array, ""]
) -> Float[Array, "samples 3"]:
    """Curvature, stretch and shear of a sampled line whose base points along x.

    Angles are those of the chords and curvatures their differences, so that integrating
    the curvature gives every chord angle back. The section follows the tangent: no shear.
    """
    step = length / (positions.shape[0] - 1)
    chord = jnp.diff(positions, axis=0)
    stretch = jnp.sqrt(jnp.sum(chord**2, axis=1)) / step
    turn = _turns(chord)
    base = jnp.arctan2(chord[0, 1], chord[0, 0])[None]
    # The base and the tip own half a step each; the tip adds no curvature.
    kappa = jnp.concatenate([2 * base, turn, jnp.zeros(1, positions.dtype)]) / step
    middle = (stretch[1:] + stretch[:-1]) / 2
    sigma = jnp.concatenate([stretch[:1], middle, stretch[-1:]])
    return jnp.stack([kappa, sigma, jnp.zeros_like(sigma)], axis=1)


def _turns(chord: Float[Array, "chords 2"]) -> Float[Array, " turns"]:
    """Angle from each chord to the next [rad]."""
    a, b = chord[:-1], chord[1:]
    return jnp.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], jnp.sum(a * b, axis=1))


def strain_along(path: Path, line: Line, *, samples: int = 81) -> Backbone:
    """Backbone snapshots of a load path along a material line.

    Args:
        path: Equilibria, from `fem.solve_path`.
        line: The line in the reference configuration; its start should be held fast.
        samples: Equally spaced samples along the line; about one per cell.

    Raises:
        ValueError: If the line leaves the mesh.
    """
    at = probe(path.problem.mesh, line, samples)
    positions = jax.vmap(at)(path.displacements)
    strain = jax.vmap(lambda r: line_strain(r, at.length))(positions)
    return Backbone(at.s, at.length, positions, strain)
