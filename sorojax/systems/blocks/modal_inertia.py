"""Inertia of a solid in a few shapes that moves with a frame: integrals over places and shapes,
taken once, from which mass and forces follow at every state."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.math.linalg.sparse import SparseSymmetric, product

Shapes = Float[Array, "modes nodes dim"]


class Moved(NamedTuple):
    """Inertia at a state, along the axes of the frame, moments about its origin.

    Attributes:
        matrix: Of the solid as it is, rigid.
        coupling: Momentum by modal rates.
        wrench: That a turning frame needs to be held at zero accelerations.
        swing: The same of the modal coordinates.
    """

    matrix: Float[Array, "6 6"]
    coupling: Float[Array, "6 modes"]
    wrench: Float[Array, "6"]
    swing: Float[Array, " modes"]


class ModalInertia(eqx.Module):
    """Integrals of the density over places x and shapes f in the axes of a frame, in space.

    Attributes:
        mass: [kg].
        first, second: Of x, and of x x' [kg m], [kg m^2], at zero modal coordinates.
        shapes: Of f.
        mixed: Of f x'.
        pairs: Of f g' for every two shapes.
        rotation, origin: Axes and origin of the frame [m], where the mesh is.
        gravity: Acceleration of the weight [m/s^2], in the world.
    """

    mass: Float[Array, ""]
    first: Float[Array, "3"]
    second: Float[Array, "3 3"]
    shapes: Float[Array, "modes 3"]
    mixed: Float[Array, "modes 3 3"]
    pairs: Float[Array, "modes modes 3 3"]
    rotation: Float[Array, "dim dim"]
    origin: Float[Array, " dim"]
    gravity: Float[Array, " dim"]

    def in_frame(self, x: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """A place where the mesh is [m] in the frame."""
        return self.rotation.T @ (x - self.origin)

    def centre(self, q: Float[Array, " modes"]) -> Float[Array, "3"]:
        """Centre of mass in the frame [m]."""
        return (self.first + q @ self.shapes) / self.mass

    def moved(
        self, q: Float[Array, " modes"], v: Float[Array, " modes"], spin: Float[Array, "3"]
    ) -> Moved:
        """At modal coordinates and rates, in a frame that turns by `spin` [rad/s]."""
        placed, centre, second = self._places(q)
        coupling = jnp.concatenate([_axial(placed), self.shapes], axis=1).T
        about = jnp.trace(second) * jnp.eye(3, dtype=q.dtype) - second
        flow = jnp.tensordot(v, placed, 1)  # of the rate of x, times x'
        drift = v @ self.shapes
        turning = jnp.cross(spin, about @ spin)
        turning = turning + 2 * (jnp.trace(flow) * spin - flow @ spin)
        swept = jnp.cross(spin, jnp.cross(spin, centre) + 2 * drift)
        along = jnp.einsum("i,kij,j->k", spin, placed, spin)
        outward = along - (spin @ spin) * jnp.trace(placed, axis1=1, axis2=2)
        sideways = 2 * _axial(jnp.einsum("klij,l->kij", self.pairs, v)) @ spin
        return Moved(
            self._matrix(centre, about),
            coupling,
            jnp.concatenate([turning, swept]),
            outward + sideways,
        )

    def kinetic_energy(
        self, q: Float[Array, " modes"], v: Float[Array, " modes"], twist: Float[Array, "6"]
    ) -> Float[Array, ""]:
        """Energy [J] of modes of unit mass in a frame that moves with `twist`."""
        whole = self.moved(q, v, twist[:3])
        return twist @ (whole.matrix @ twist / 2 + whole.coupling @ v) + v @ v / 2

    def _places(self, q):
        """Integrals of f x', x and x x' at q."""
        placed = self.mixed + jnp.einsum("klij,l->kij", self.pairs, q)
        first = self.first + q @ self.shapes
        half = jnp.tensordot(q, placed, 1)
        return placed, first, self.second + half + jnp.tensordot(q, self.mixed, 1).T

    def _matrix(self, centre, about) -> Float[Array, "6 6"]:
        x, y, z = centre
        none = jnp.zeros_like(x)
        cross = jnp.stack([none, -z, y, z, none, -x, -y, x, none]).reshape(3, 3)
        unit = self.mass * jnp.eye(3, dtype=about.dtype)
        return jnp.block([[about, cross], [cross.T, unit]])


def _axial(matrices: Float[Array, "modes 3 3"]) -> Float[Array, "modes 3"]:
    """x cross f of sums f x'."""
    below = [matrices[:, i, j] - matrices[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))]
    return jnp.stack(below, axis=1)


def modal_inertia(
    system: SparseSymmetric,
    mass: Float[Array, " nnz"],
    points: Float[Array, "nodes dim"],
    shapes: Shapes,
    pose: Float[Array, "h h"],
    gravity: Float[Array, " dim"],
) -> ModalInertia:
    """The integrals by a mass matrix.

    Args:
        system: Of the mass matrix.
        mass: Its entries [kg].
        points: Places at zero modal coordinates, where the mesh is [m].
        shapes: Of unit modal mass.
        pose: Of the frame, where the mesh is.
        gravity: Acceleration of the weight [m/s^2], in the world.
    """
    dim, count = points.shape[1], shapes.shape[0]
    rotation, origin = pose[:dim, :dim], pose[:dim, dim]
    inside = (points - origin[None]) @ rotation
    turned = shapes @ rotation
    one = jnp.ones((1, points.shape[0]), points.dtype)
    fields = [one, inside.T, jnp.moveaxis(turned, 2, 1).reshape(-1, points.shape[0])]
    every = jnp.concatenate(fields)

    def weighed(field):  # the matrix is that of a scalar in each component
        spread = jnp.zeros_like(points).at[:, 0].set(field)
        return product(system, mass, spread.ravel()).reshape(points.shape)[:, 0]

    gram = every @ jax.lax.map(weighed, every).T
    place = np.arange(1, 1 + dim)
    modes = 1 + dim + np.arange(count * dim).reshape(count, dim)
    rows, columns = modes[:, None, :, None], modes[None, :, None, :]

    return ModalInertia(
        gram[0, 0],
        jnp.pad(gram[0, place], (0, 3 - dim)),
        jnp.pad(gram[place[:, None], place], (0, 3 - dim)),
        jnp.pad(gram[0, modes], ((0, 0), (0, 3 - dim))),
        jnp.pad(gram[modes[:, :, None], place], ((0, 0), (0, 3 - dim), (0, 3 - dim))),
        jnp.pad(gram[rows, columns], ((0, 0), (0, 0), (0, 3 - dim), (0, 3 - dim))),
        rotation,
        origin,
        gravity,
    )
