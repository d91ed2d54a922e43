"""Where the rod is: strains, poses, Jacobians."""

from typing import overload

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.math.compiled import jit_public
from sorojax.math.lie import homogeneous
from sorojax.rod.dynamics.fields import RodState, rest_along, strains_at
from sorojax.rod.dynamics.moving import spin_cross, turned_twists
from sorojax.rod.dynamics.points import Points, from_base
from sorojax.rod.dynamics.tree import (
    AssemblyState,
    bias_accelerations,
    bias_rates,
    part_columns,
    part_motion,
    rod_motion,
)
from sorojax.rod.model.assembly import Assembly
from sorojax.rod.model.link import LinkState
from sorojax.rod.model.model import Model, inertia as inertia, motion as motion
from sorojax.rod.model.rod import Rod

_TIP = np.ones(1)

Poses = Float[Array, "points h h"]
Jacobians = Float[Array, "points twist dof"]


@jit_public
def strain(
    rod: Rod, q: Float[Array, " dof"], s: Numbers | None = None
) -> Float[Array, "points strain"]:
    """Strain of the section: curvatures [1/m], then stretch and shears [-].

    Args:
        rod: The rod.
        q: Coordinates.
        s: Where, in [0, 1]; the Gauss nodes if omitted.

    Returns:
        One strain per place.
    """
    rest, rows = strains_at(rod, None if s is None else real(s).astype(q.dtype))
    return rest + rows @ q


@overload
def forward_kinematics(model: Rod, q: Array, s: Numbers | None = None) -> Poses: ...
@overload
def forward_kinematics(
    model: Assembly, q: Array, s: Numbers | None = None
) -> dict[str, Poses]: ...
@jit_public
def forward_kinematics(
    model: Model, q: Float[Array, " coordinates"], s: Numbers | None = None
) -> Poses | dict[str, Poses]:
    """Poses of the cross-sections, from local to base frame.

    g' = g xi^ integrated along the rod from its base: rotations by exponentials of the strain
    over the intervals between Gauss nodes (Magnus), positions by spectral integration.

    Args:
        model: The rod or assembly.
        q: Coordinates; curvature modes in [1/m].
        s: Where, a list of points in [0, 1]; the Gauss nodes by default.

    Returns:
        Homogeneous matrices, positions [m]; of an assembly those of every part by name, one for
        a link.

    Raises:
        ValueError: If `s` is no list of points.

    Example:
        >>> finger = rod.rod(SE2(), rod.chebyshev(kappa_z=3), rod.circle(5 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> poses = rod.forward_kinematics(finger, jnp.array([10.0, 0.0, 0.0]), [0.5, 1.0])
        >>> (poses[:, :2, 2] / mm).round(2).tolist()  # an arc of radius 100 mm
        [[47.94, 12.24], [84.15, 45.97]]

    Reference:
        Boyer, Lebastard, Candelier and Renda, Dynamics of continuum and soft robots: a strain
        parameterization based approach, IEEE T-RO 37, 2021.
    """
    if isinstance(model, Assembly):
        return {name: _poses(part, s) for name, part in _parts(motion(model, q))}
    return _poses(rod_motion(model, q), s)


@overload
def tip_pose(model: Rod, q: Array) -> Float[Array, "h h"]: ...
@overload
def tip_pose(model: Assembly, q: Array) -> dict[str, Float[Array, "h h"]]: ...
@jit_public
def tip_pose(model: Model, q: Float[Array, " coordinates"]):
    """Pose of the last cross-section, from local to base frame.

    `forward_kinematics` at s = 1.

    Args:
        model: The rod or assembly.
        q: Coordinates; curvature modes in [1/m].

    Returns:
        A homogeneous matrix, position [m]; of an assembly those of every part by name.

    Example:
        >>> finger = rod.rod(SE2(), rod.chebyshev(kappa_z=3), rod.circle(5 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> (rod.tip_pose(finger, jnp.zeros(3))[:2, 2] / mm).round(2).tolist()
        [100.0, 0.0]
    """
    if isinstance(model, Assembly):
        return {name: _poses(part, _TIP)[0] for name, part in _parts(motion(model, q))}
    return _poses(rod_motion(model, q), _TIP)[0]


@overload
def jacobian(model: Rod, q: Array, s: Numbers | None = None) -> Jacobians: ...
@overload
def jacobian(model: Assembly, q: Array, s: Numbers | None = None) -> dict[str, Jacobians]: ...
@jit_public
def jacobian(
    model: Model, q: Float[Array, " coordinates"], s: Numbers | None = None
) -> Jacobians | dict[str, Jacobians]:
    """Twists of the sections per coordinate rate, angular velocity first, world frame.

    Args:
        model: The rod; of an assembly the Jacobians of every part by name, one for a link.
        q: Coordinates.
        s: Where, in [0, 1]; the Gauss nodes if omitted.

    Returns:
        One matrix per place, of six rows in space and three in the plane; by part for an
        assembly.
    """
    if isinstance(model, Rod):
        return _jacobian(rod_motion(model, q), s)
    moment = motion(model, q)
    return {
        name: _jacobian(part, s) @ columns
        for (name, part), columns in zip(_parts(moment), part_columns(moment), strict=True)
    }


@jit_public
def jacobian_rate_product(
    model: Model,
    q: Float[Array, " coordinates"],
    v: Float[Array, " dof"],
    s: Numbers | None = None,
) -> Float[Array, "points twist"] | dict[str, Float[Array, "points twist"]]:
    """dJ/dt v: accelerations of the sections that velocity alone makes, world frame.

    Args:
        model: The rod; of an assembly those of every part by name, one for a link.
        q: Coordinates.
        v: Their rates.
        s: Where, in [0, 1]; the Gauss nodes if omitted.

    Returns:
        One twist rate per place; by part for an assembly.
    """
    if isinstance(model, Rod):
        return _rate_product(rod_motion(model, q, v), s, None)
    moment = motion(model, q, v)
    ground = zip(_parts(moment), moment.frames, bias_accelerations(moment), strict=True)
    found = {}
    for (name, part), frame, local in ground:
        start = None
        if local is not None:
            rot = model.group.rotation_dim
            start = turned_twists(frame.rotation, local[:, None], rot)[:, 0]
        found[name] = _rate_product(part, s, start)
    return found


def tip_angle(moment: RodState) -> Float[Array, ""]:
    """Angle of the last section of a planar rod on its base [rad], continuous past half a
    turn.

    Args:
        moment: State of a planar rod, from `motion`.

    Returns:
        The angle [rad].
    """
    if moment.rod.group.space_dim != 2:
        raise ValueError("tip_angle: needs a planar rod, got a spatial one. Use tip_pose.")
    bending = moment.angular_rate[:, 0] @ moment.q
    return moment.operators.weights @ (bending + rest_along(moment.operators)[:, 0])


def _parts(moment: AssemblyState) -> list[tuple[str, RodState | LinkState]]:
    names = moment.assembly.names
    return [(name, part_motion(moment, k)) for k, name in enumerate(names)]


def _poses(moment: RodState | LinkState, s) -> Poses:
    if isinstance(moment, LinkState):
        return homogeneous(moment.base.directors, moment.base.position)[None]
    if s is None:
        return homogeneous(moment.directors, moment.position)
    at = Points(moment, _rows(moment.rod, s))
    return homogeneous(at.directors, at.position)


def _jacobian(moment: RodState | LinkState, s) -> Jacobians:
    if isinstance(moment, LinkState):
        return moment.tip_jacobian[None]
    at = moment if s is None else Points(moment, _rows(moment.rod, s))
    return jnp.concatenate([at.angular_jacobian, at.linear_jacobian], axis=1)


def _rate_product(
    moment: RodState | LinkState, s, start: Float[Array, " twist"] | None
) -> Float[Array, "points twist"]:
    """Velocity-product accelerations, on a base that has the acceleration `start`."""
    if isinstance(moment, LinkState):
        return jnp.zeros_like(moment.v)[None] if start is None else start[None]
    rows = moment.operators.integration if s is None else _rows(moment.rod, s)
    angular, linear = (rows @ rate for rate in bias_rates(moment))
    if start is not None:
        rot, at = angular.shape[1], Points(moment, rows)
        assert moment.base is not None
        arms = at.position - moment.base.position[None]
        angular = angular + start[None, :rot]
        linear = linear + start[None, rot:] + spin_cross(start[None, :rot], arms)
    return jnp.concatenate([angular, linear], axis=1)


def _rows(rod: Rod, s) -> Float[Array, "points quad"]:
    """Integration weights from the base to each s [m]."""
    s = s if s is _TIP else real(s).astype(rod.length.dtype)
    _check.shape("rod", "s", s, (None,), "Give a list of points in [0, 1].")
    return from_base(rod, s)
