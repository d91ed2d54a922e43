"""The uniform section that carries the mass of a body along a curve."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sorojax._types import Numbers
from sorojax.fem.kinematics import PlaneStrain, Solid
from sorojax.fem.points import quadrature_points
from sorojax.fem.problem import Problem
from sorojax.math.spatial import KDTree
from sorojax.reduction.curve import AbstractCurve, reference
from sorojax.rod import Section

_SAMPLES = 201


def mean_section(
    problem: Problem, curve: AbstractCurve, *, up: Numbers | None = None
) -> Section:
    """The section of a uniform rod along `curve` with the mass of the body, its mean offset
    from the curve and its rotary inertia about it. Of a solid the torsion constant is the
    polar moment, an upper bound.

    Raises:
        ValueError: If the body is neither plane strain nor solid.
    """
    kinematics = problem.kinematics
    if not isinstance(kinematics, PlaneStrain | Solid):
        raise ValueError(
            f"mean_section: got {type(kinematics).__name__}, need PlaneStrain or Solid. Give "
            "the rod a section of your own."
        )
    known = reference(curve, _SAMPLES, up)
    inside = quadrature_points(problem.mesh, kinematics)
    points = jnp.moveaxis(inside.position, 0, -1).reshape(-1, kinematics.dim)
    near = KDTree(known.position).query(np.asarray(jax.lax.stop_gradient(points)))[1]
    axes = known.position[near], known.frame[near]
    volume, offsets, moments = _moments(points, inside.volumes.reshape(-1), *axes)
    area, about_z = volume / known.length, moments[0] / known.length
    if isinstance(kinematics, Solid):
        about_y = moments[1] / known.length
    else:
        about_y = area * kinematics.thickness**2 / 12
    return Section(
        area, about_y, about_z, about_y + about_z, 5 / 6,
        mass_offset_y=offsets[0], mass_offset_z=offsets[1] if len(offsets) > 1 else None,
    )  # fmt: skip


@jax.jit
def _moments(
    points: Array, volumes: Array, places: Array, frames: Array
) -> tuple[Array, list[Array], list[Array]]:
    """Volume, its mean place along each axis of the section, and its second moments."""
    local = jnp.einsum("pi,pij->pj", points - places, frames)
    total, across = jnp.sum(volumes), [local[:, k] for k in range(1, local.shape[1])]
    means = [jnp.sum(volumes * x) / total for x in across]
    return total, means, [jnp.sum(volumes * x**2) for x in across]
