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
from sorojax.fem.point_tangent import Tangent, point_tangent
from sorojax.fem.shape_response import (
    Shape,
    ShapeVectors,
    shape_energy,
    shape_response,
    shape_stress,
    stiffened,
)
from sorojax.fem.tensor import (
    Entries,
    extrapolated_piola,
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
    tangent: Tangent
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
    law, before = alone(lambda: (_law(body, F), _before(body, F_before, F - F_before)))
    return alone(lambda: _with_tangent(body, F, F_before, law, before))


class _Law(NamedTuple):
    """Stress and parts of the tangent of the shape energy; p, bulk stiffness and dJ/dF."""

    P: Entries
    shape: Shape
    volumetric: tuple[Entry, Entry, Entries] | None


class _Before(NamedTuple):
    """Stress of the shape energy at the previous iterate, its change by the step, and the
    extrapolated pressure."""

    P: Entries
    rate: Entries
    p: Entry | None


def _law(body: Body, F: Entries) -> _Law:
    P, shape = shape_response(body.material, body.kinematics, F)
    if not body.kinematics.has_volume:
        return _Law(P, shape, None)
    p, bulk, C = _volumetric(body, F)
    if body.modes is None:
        shape = stiffened(shape, bulk, C)
    return _Law(P, shape, (p, bulk, C))


def _before(body: Body, F: Entries, step: Entries) -> _Before:
    def stress(F):
        return shape_stress(body.material, body.kinematics, F)

    P, rate = jax.jvp(stress, (F,), (step,))
    if not body.kinematics.has_volume:
        return _Before(P, rate, None)
    p, p_rate = jax.jvp(lambda F: pressure(body, F), (F,), (step,))
    return _Before(P, rate, p + p_rate)


def _with_tangent(body: Body, F, F_before, law: _Law, before: _Before) -> Response:
    weight = law.shape.weight if isinstance(law.shape, ShapeVectors) else None
    if before.p is not None:
        weight = before.p if weight is None else weight + before.p
    S = _geometric_stress(body, F, F_before, law.P, before)
    tangent = point_tangent(body.kinematics, F, law.shape, weight, S)
    if law.volumetric is None:
        return Response(law.P, tangent, None, None)
    p, bulk, C = law.volumetric
    stress = law.P + p[None] * C
    if body.modes is None:
        return Response(stress, tangent, None, None)
    stiffness = [coefficients(body.modes, body.volumes, bulk * mode) for mode in body.modes]
    return Response(stress, tangent, C, jnp.stack(stiffness))


def _geometric_stress(body: Body, F, F_before, P, before: _Before) -> tuple[Entry, ...]:
    """S of the shape energy extrapolated to `F`, minus S(F)."""
    S_before = extrapolated_piola(
        body.kinematics, F_before, F - F_before, before.P, before.rate
    )
    S = [a - b for a, b in zip(S_before, second_piola(body.kinematics, F, P), strict=True)]
    share = finite_share(body.material)
    if share is None:
        return tuple(S)
    # cells of small strains may invert on the way, where S is infinite; theirs is exact
    finite = jnp.broadcast_to(share > 0.9, S[0].shape)
    return tuple(jnp.where(finite, s, jnp.zeros_like(s)) for s in S)


def _dilatation(body: Body, F: Entries) -> Entry:
    return project(body.modes, body.volumes, volume_ratio(body.kinematics, F))


def _volumetric_slope(body: Body, J: Entry) -> Entry:
    return jax.grad(lambda J: jnp.sum(body.material.volumetric_energy(J)))(J)


def _volumetric(body: Body, F: Entries) -> tuple[Entry, Entry, Entries]:
    J = _dilatation(body, F)
    slope, bulk = jax.jvp(lambda J: _volumetric_slope(body, J), (J,), (jnp.ones_like(J),))
    p = project(body.modes, body.volumes, slope)
    return p, bulk, volume_slopes(body.kinematics, F)
