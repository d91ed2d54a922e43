"""Rigid links: bodies of an assembly that do not bend."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.rod.dynamics.fields import Base
from sorojax.rod.dynamics.moving import levers, placed, spin_cross, swept


class Link(eqx.Module):
    """A rigid body.

    Attributes:
        mass: [kg]; 0, with an inertia of 0, of a frame between two joints.
        inertia: About the centre of mass, along the axes of the link [kg m^2]: a number in
            a plane; in space three principal moments or a symmetric matrix.
        center: Centre of mass in the frame of the link [m]; its origin if omitted.
    """

    mass: Float[Array, ""] = eqx.field(converter=real)
    inertia: Float[Array, "..."] = eqx.field(converter=real)
    center: Float[Array, " dim"] | None = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        do = "Give [kg]; only a frame between two joints has none."
        _check.not_negative("Link", "mass", self.mass, "kg", do)
        if jnp.shape(self.inertia) not in ((), (3,), (3, 3)):
            raise ValueError(
                f"Link: `inertia` has shape {jnp.shape(self.inertia)}, need () in a plane, "
                "(3) or (3, 3) in space. Give principal moments [kg m^2]."
            )
        if self.inertia.ndim < 2 and not is_massless(self):
            do = "Give moments in kg m^2, e.g. 2/5 m r^2 for a ball."
            _check.positive("Link", "inertia", self.inertia, "kg m^2", do)


def is_massless(link: Link) -> bool:
    """Whether a link is known to have no mass."""
    return _check.is_concrete(link.mass) and float(link.mass) == 0


class LinkOperators(NamedTuple):
    """Constants of a link: its mass as a list of one [kg], no stiffness, and no offset from
    its centre of mass."""

    mass: Float[Array, "1"]
    stiffness: Float[Array, "0 0"]
    mass_offset: None = None


class LinkState(eqx.Module):
    """A link at one moment, read like the `RodState` of a rod with one section: its centre of
    mass. The columns of the Jacobians are the twist of its frame; q is zero.

    `tip_jacobian` is that of the frame of the link.
    """

    link: Link
    operators: LinkOperators
    q: Float[Array, " dof"]
    v: Float[Array, " dof"]
    base: Base

    @property
    def directors(self) -> Float[Array, "1 dim dim"]:
        return self.base.directors[None]

    @property
    def tangent(self) -> Float[Array, "1 dim"]:
        return self.base.directors[None, :, 0]

    @property
    def position(self) -> Float[Array, "1 dim"]:
        """Centre of mass [m]."""
        arm = self._arm
        return (self.base.position if arm is None else self.base.position + arm)[None]

    @property
    def angular_jacobian(self) -> Float[Array, "1 rot dof"]:
        return self.base.angular_jacobian[None]

    @property
    def linear_jacobian(self) -> Float[Array, "1 dim dof"]:
        arm, linear = self._arm, self.base.linear_jacobian[None]
        return linear if arm is None else linear + swept(self.angular_jacobian, arm[None])

    @property
    def tip_jacobian(self) -> Float[Array, "twist dof"]:
        return jnp.concatenate([self.base.angular_jacobian, self.base.linear_jacobian])

    @property
    def rotary(self) -> Float[Array, "rot rot"]:
        """Inertia about the centre of mass, along the axes of the link [kg m^2]."""
        inertia = self.link.inertia.astype(self.v.dtype)
        return _matrix(inertia, self.base.angular_jacobian.shape[0])

    @property
    def _arm(self) -> Float[Array, " dim"] | None:
        """To the centre of mass [m]; None where the frame is there."""
        if self.link.center is None:
            return None
        return self.base.directors @ center(self.link, self.base.position)


def center(link: Link, like: Float[Array, " dim"]) -> Float[Array, " dim"]:
    """Centre of mass in the frame of the link [m]."""
    return jnp.zeros_like(like) if link.center is None else link.center.astype(like.dtype)


def link_operators(link: Link, dtype) -> LinkOperators:
    """The constant arrays of `link`."""
    return LinkOperators(link.mass.astype(dtype)[None], jnp.zeros((0, 0), dtype))


def link_motion(
    link: Link, constants: LinkOperators, twist: Float[Array, " twist"]
) -> LinkState:
    """The link moving with `twist`, in its own axes."""
    rot = {3: 1, 6: 3}[twist.shape[0]]
    eye = jnp.asarray(np.eye(twist.shape[0]), twist.dtype)
    dim = twist.shape[0] - rot
    home = jnp.asarray(np.eye(dim), twist.dtype), jnp.zeros(dim, twist.dtype)
    base = Base(*home, eye[:rot], eye[rot:])
    return LinkState(link, constants, jnp.zeros_like(twist), twist, base)


def place_link(moment: LinkState, rotation: Array, position: Array) -> LinkState:
    """A motion in own axes in a frame in which the link stands at (rotation, position)."""
    return dataclasses.replace(moment, base=placed(moment.base, rotation, position))


def link_inertia(
    moment: LinkState,
) -> tuple[Float[Array, "twist twist"], Float[Array, " twist"]]:
    """Mass matrix and Coriolis force of a link about its frame, in its own axes."""
    rot, dim = moment.base.angular_jacobian.shape[0], moment.base.position.shape[0]
    mass, spin, about = moment.operators.mass[0], moment.v[:rot], moment.rotary
    coupling, torque = jnp.zeros((dim, rot), about.dtype), jnp.zeros(rot, about.dtype)
    turning, force = about, jnp.zeros(dim, about.dtype)
    if moment.link.center is not None:
        arm = center(moment.link, moment.base.position)[None]
        lever = levers(arm)[0]
        turning, coupling = about + mass * lever.T @ lever, mass * lever
        force = mass * spin_cross(spin[None], spin_cross(spin[None], arm))[0]
        torque = lever.T @ force
    if rot == 3:
        torque = torque + jnp.cross(spin, about @ spin)
    moving = mass * jnp.asarray(np.eye(dim), about.dtype)
    top, low = [turning, coupling.T], [coupling, moving]
    matrix = jnp.concatenate([jnp.concatenate(row, axis=1) for row in (top, low)])
    return matrix, jnp.concatenate([torque, force])


def _matrix(inertia: Array, rot: int) -> Float[Array, "rot rot"]:
    need = "a number" if rot == 1 else "three moments or a matrix"
    if (inertia.ndim == 0) != (rot == 1):
        raise ValueError(
            f"Link: `inertia` has shape {inertia.shape}, need {need}: a planar link turns "
            "about z only, a spatial one about three axes."
        )
    if rot == 1:
        return inertia.reshape(1, 1)
    return jnp.diag(inertia) if inertia.ndim == 1 else inertia
