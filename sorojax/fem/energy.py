"""Stress and tangent at points, elementwise on the kept entries of F.

The tangent may take its geometric parts from a pressure and an isochoric second
Piola-Kirchhoff stress that are extrapolated linearly from the previous iterate (mixed
integration point method): the residual is untouched, and Newton's method for nearly
incompressible solids needs a fraction of the iterations. The rotation of a cell within
an iterate is second order in the update but enters J multiplied by the bulk modulus.

Reference: Magisano, Leonetti, Garcea, "How to improve efficiency and robustness of the
Newton method in geometrically non-linear structural problem discretized via
displacement-based finite elements", CMAME 313, 2017.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.fem.formulation import Modes, coefficients, project
from sorojax.fem.kinematics import AbstractKinematics
from sorojax.fem.shape_response import (
    ShapeVectors,
    shape_energy,
    shape_response,
    shape_stress,
    shape_tangent,
)
from sorojax.fem.tensor import (
    Entries,
    geometric_part,
    second_piola,
    volume_ratio,
    volume_slopes,
)
from sorojax.material.hyperelastic import AbstractHyperelastic, finite_share
from sorojax.material.kinematics import Entry
from sorojax.math.apart import Alone


class Body(NamedTuple):
    """What the energy of a block of cells is made of."""

    material: AbstractHyperelastic
    kinematics: AbstractKinematics
    modes: Modes | None
    volumes: Float[Array, "quad lanes"]


class Response(NamedTuple):
    """Stress P and dP/dF between kept entries of F.

    With pressure modes the bulk stiffness is not in `tangent`: `slopes` holds
    dJ/dF and `stiffness` that between modes.
    """

    stress: Entries
    tangent: Float[Array, "entries entries quad lanes"]
    slopes: Entries | None
    stiffness: Float[Array, "modes modes lanes"] | None


def energy_density(body: Body, F: Entries) -> Entry:
    """Psi at every point [J/m^3], its volumetric part from the projected J."""
    shape = shape_energy(body.material, body.kinematics, F)
    if not body.kinematics.has_volume:
        return shape
    return shape + body.material.volumetric_energy(_dilatation(body, F))


def pressure(body: Body, F: Entries) -> Entry:
    """dU/dJ at every point [Pa], as projected."""
    slope = _volumetric_slope(body, _dilatation(body, F))
    return project(body.modes, body.volumes, slope)


def response(body: Body, F: Entries, F_before: Entries, alone: Alone) -> Response:
    """P and dP/dF, the geometric parts of dP/dF from stresses extrapolated out of
    `F_before`. With `F_before` equal to `F` the tangent is the exact derivative."""
    vectors = alone(lambda: _vectors(body, F, F_before))
    return alone(lambda: _with_tangent(body, F, *vectors))


def _vectors(body: Body, F: Entries, F_before: Entries):
    """Stress and parts of the tangent of the shape energy, the extrapolated S and pressure,
    and the volumetric part: p, bulk stiffness and dJ/dF."""
    P, parts = shape_response(body.material, body.kinematics, F)
    step = F - F_before
    S = _extrapolated_shape(body, F, F_before, step, P)
    if not body.kinematics.has_volume:
        return P, parts, S, None, None
    p_before, p_rate = jax.jvp(lambda F: pressure(body, F), (F_before,), (step,))
    return P, parts, S, p_before + p_rate, _volumetric(body, F)


def _with_tangent(body: Body, F, P, parts, S, p, volumetric) -> Response:
    weight = parts.weight if isinstance(parts, ShapeVectors) else None
    if p is not None:
        weight = p if weight is None else weight + p
    tangent = shape_tangent(parts) + geometric_part(body.kinematics, F, weight, S)
    if volumetric is None:
        return Response(P, tangent, None, None)
    p, bulk, C = volumetric
    stress = P + p[None] * C
    if body.modes is None:
        return Response(stress, tangent + (bulk[None] * C)[:, None] * C[None], None, None)
    stiffness = [coefficients(body.modes, body.volumes, bulk * mode) for mode in body.modes]
    return Response(stress, tangent, C, jnp.stack(stiffness))


def _extrapolated_shape(body: Body, F, F_before, step, P) -> Entries:
    """S of the shape energy extrapolated from `F_before` to `F`, minus S(F)."""

    def stress(F):
        return second_piola(body.kinematics, F, shape_stress(body.material, body.kinematics, F))

    before, rate = jax.jvp(stress, (F_before,), (step,))
    S = before + rate - second_piola(body.kinematics, F, P)
    share = finite_share(body.material)
    if share is None:
        return S
    # cells of small strains may invert on the way, where S is infinite; theirs is exact
    return jnp.where(jnp.broadcast_to(share > 0.9, S.shape[1:])[None], S, jnp.zeros_like(S))


def _dilatation(body: Body, F: Entries) -> Entry:
    return project(body.modes, body.volumes, volume_ratio(body.kinematics, F))


def _volumetric_slope(body: Body, J: Entry) -> Entry:
    return jax.grad(lambda J: jnp.sum(body.material.volumetric_energy(J)))(J)


def _volumetric(body: Body, F: Entries) -> tuple[Entry, Entry, Entries]:
    J = _dilatation(body, F)
    slope, bulk = jax.jvp(lambda J: _volumetric_slope(body, J), (J,), (jnp.ones_like(J),))
    p = project(body.modes, body.volumes, slope)
    return p, bulk, volume_slopes(body.kinematics, F)
