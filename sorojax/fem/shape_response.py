"""Energy of the change of shape, its stress and its tangent, over arrays of entries of F.

Energies of the first isochoric invariant have a closed form; any other energy is
differentiated at the point.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._jax.programs import depends
from sorojax.fem.kinematics import AbstractKinematics
from sorojax.fem.tensor import (
    Entries,
    volume_ratio,
    volume_slopes,
)
from sorojax.material.hyperelastic import AbstractHyperelastic, first_invariant_energy
from sorojax.material.kinematics import Entry, square_norm
from sorojax.math.root import inverse_cube_root


def shape_energy(
    material: AbstractHyperelastic, kinematics: AbstractKinematics, F: Entries
) -> Entry:
    """Energy that is not a function of J alone at every point [J/m^3]."""
    return kinematics.shape_energy(material, tuple(F))


def shape_stress(
    material: AbstractHyperelastic, kinematics: AbstractKinematics, F: Entries
) -> Entries:
    """Its first Piola-Kirchhoff stress [Pa]."""
    W = _closed_form(material, kinematics)
    if W is None:
        return jax.grad(lambda F: jnp.sum(shape_energy(material, kinematics, F)))(F)
    x, slopes = _first_invariant(kinematics, F)
    return _slope(W)(x)[None] * slopes


class ShapeVectors(NamedTuple):
    """What dP/dF is made of, where the energy is one of the first isochoric invariant: an outer
    product of `half` and C = dJ/dF with its transpose, `second` times that of the slopes of the
    invariant (`None`: the energy is linear in it), a multiple `flat` of unity, and `weight`
    times d2J / dF dF."""

    half: Entries
    C: Entries
    slopes: Entries
    second: Entry | None
    flat: Entry
    weight: Entry


#: dP/dF of the shape energy, or what it is made of.
Shape = ShapeVectors | Float[Array, "entries entries quad lanes"]


def shape_response(
    material: AbstractHyperelastic, kinematics: AbstractKinematics, F: Entries
) -> tuple[Entries, Shape]:
    """Stress P [Pa], and dP/dF or what it is made of [Pa]."""
    W = _closed_form(material, kinematics)
    if W is None:
        stress = shape_stress(material, kinematics, F)
        return stress, _differentiated(material, kinematics, F)
    inverse, scale, I1, C = _parts(kinematics, F)
    x, slopes = _first_invariant(kinematics, F)
    first, second = _slope(W)(x), None
    if depends(_slope(W), x):
        second = jax.jvp(_slope(W), (x,), (jnp.ones_like(x),))[1]
    half = (first * scale * inverse)[None] * (5 / 9 * (I1 * inverse)[None] * C - 4 / 3 * F)
    weight = -2 / 3 * first * scale * I1 * inverse
    vectors = ShapeVectors(half, C, slopes, second, 2 * first * scale, weight)
    return first[None] * slopes, vectors


def stiffened(shape: Shape, bulk: Entry, C: Entries) -> Shape:
    """`shape` with `bulk` times the outer product of C = dJ/dF with itself."""
    if isinstance(shape, ShapeVectors):
        return shape._replace(half=shape.half + (0.5 * bulk)[None] * C)
    return shape + (bulk[None] * C)[:, None] * C[None]


def _differentiated(material, kinematics: AbstractKinematics, F: Entries):
    num = F.shape[0]
    unit = jnp.eye(num, dtype=F.dtype)[:, :, None, None]

    def column(direction):
        return jax.jvp(lambda F: shape_stress(material, kinematics, F), (F,), (direction,))

    units = jnp.broadcast_to(unit, (num, *F.shape))
    return jax.vmap(lambda direction: column(direction)[1])(units)


def _closed_form(material: AbstractHyperelastic, kinematics: AbstractKinematics):
    return first_invariant_energy(material) if kinematics.has_volume else None


def _slope(W):
    return lambda x: jax.grad(lambda x: jnp.sum(W(x)))(x)


def _parts(kinematics: AbstractKinematics, F: Entries):
    """1/J, J^(-2/3), I1 and dJ/dF."""
    root = inverse_cube_root(volume_ratio(kinematics, F))
    scale = root * root
    I1 = square_norm(kinematics.embed(tuple(F)))
    return scale * root, scale, I1, volume_slopes(kinematics, F)


def _first_invariant(kinematics: AbstractKinematics, F: Entries) -> tuple[Entry, Entries]:
    """I1_bar - 3 and its derivative by F."""
    inverse, scale, I1, C = _parts(kinematics, F)
    slopes = (2 * scale)[None] * F - (2 / 3 * scale * I1 * inverse)[None] * C
    return scale * I1 - 3, slopes
