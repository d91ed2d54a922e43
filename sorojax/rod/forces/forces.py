"""Generalised forces on a rod, listed in a tuple: what is absent costs nothing.

To add one, subclass the family that fits:

* `AbstractForce`: any force, a function of time and the `RodState` of the rod; `points`
  gives poses, velocities and Jacobians at any s, and takes forces put there.
* `AbstractElastic`: an elastic law that replaces the rod's own linear one.
* `AbstractDamping`: a constant matrix; implicit steppers use it in their iteration.
* `AbstractPressureMap`: the work of a fluid; its pressure comes from a network, or from
  `Pressurised(map, pressure)`. `AbstractChamber` is the one with rigid walls.
"""

import abc
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.jit import once
from sorojax._types import optional_real, real
from sorojax.material.viscoelastic import Prony
from sorojax.math.quadrature import gauss_legendre
from sorojax.rod.dynamics.fields import RodState, operators, strains_at
from sorojax.rod.dynamics.moving import mass_jacobian
from sorojax.rod.dynamics.points import Points, from_own, nodes, own, points, safe_norm
from sorojax.rod.model.rod import Rod

EARTH = 9.81  # m/s^2


class AbstractForce(eqx.Module):
    """A generalised force, on the side of the loads: M a + coriolis = sum of forces.

    `motion` is the rod at one moment, a `rod.RodState`. It offers:

    * `motion.q`, `motion.v`: coordinates and their rates, `(dof,)`;
    * `motion.rod`: the rod, with `length` [m], `section`, `material`, `group`, `basis`;
    * at the Gauss nodes, world frame: `position` `(quad, dim)` [m], `directors`
      `(quad, dim, dim)`, `tangent` `(quad, dim)`, `linear_jacobian` `(quad, dim, dof)`,
      `angular_jacobian` `(quad, rot, dof)`, and the weights `motion.operators.weights`
      `(quad,)` [m] that integrate along the rod;
    * `motion.tip_jacobian` `(twist, dof)`: twist of the tip per rate, angular first;
    * `rod.points(motion, s)`: position, velocity, spin, directors and Jacobians at any s in
      [0, 1].

    What is not read is never computed. A force of 2 N/m along y, all along the rod:

        class SideWind(rod.AbstractForce):
            def __call__(self, t, motion):
                weights = motion.operators.weights
                return 2.0 * weights @ motion.linear_jacobian[:, 1]
    """

    @abc.abstractmethod
    def __call__(self, t: Float[Array, ""], motion: RodState) -> Float[Array, " dof"]:
        """Force [N m, N] that does work on the coordinate rates; power is force @ v [W].

        Args:
            t: Time [s].
            motion: The rod at this time.
        """

    def on_rod(self, rod: Rod) -> "AbstractForce":
        """The same force on `rod` alone: loops make here, once, what does not move."""
        return self


class AbstractElastic(AbstractForce):
    """An elastic law in place of the linear `-K q`.

    Implement `restoring_force`; `__call__` is given.
    """

    @abc.abstractmethod
    def restoring_force(self, q: Float[Array, " dof"]) -> Float[Array, " dof"]:
        """Derivative of the stored energy [J] in q; `K q` for a linear law."""

    def __call__(self, t, motion):
        return -from_own(motion, self.restoring_force(own(motion, motion.q)))


class AbstractDamping(AbstractForce):
    """Linear damping by a constant matrix."""

    @abc.abstractmethod
    def matrix(self, stiffness: Float[Array, "dof dof"]) -> Float[Array, "dof dof"]:
        """Damping matrix, given the linear stiffness of the rod."""

    def __call__(self, t, motion):
        matrix = self.matrix(motion.operators.stiffness)
        return -from_own(motion, matrix @ own(motion, motion.v))


class AbstractPressureMap(eqx.Module):
    """Fluid chambers in the rod, one or several ports.

    One function W(q, p) gives the force dW/dq and the volume dW/dp, so that no energy is
    lost between fluid and rod. What is left of dV/dp at fixed q is the compliance of the
    walls, one number per port: ports must not stretch each other's walls.
    """

    if TYPE_CHECKING:  # fields that subclasses have, in their own order
        ports: ClassVar[tuple[int, ...]]

    @abc.abstractmethod
    def coenergy(
        self, q: Float[Array, " dof"], pressure: Float[Array, "*ports"]
    ) -> Float[Array, ""]:
        """W(q, p) [J] at gauge pressure [Pa]; zero at zero pressure."""


class AbstractChamber(AbstractPressureMap):
    """Chambers whose volume depends on q alone: W = p . V(q)."""

    @abc.abstractmethod
    def volume(self, q: Float[Array, " dof"]) -> Float[Array, "*ports"]:
        """Enclosed volume [m^3], scalar or one per port."""

    def coenergy(self, q, pressure):
        return jnp.sum(pressure * self.volume(q))


class LinearElastic(AbstractElastic):
    """Elasticity K q with a matrix of its own, `stiffness`, e.g. identified from data: energy
    [J] per product of two coordinates, q'Kq / 2 in all."""

    stiffness: Float[Array, "dof dof"] = eqx.field(converter=real)

    def restoring_force(self, q):
        return self.stiffness @ q


class Damping(AbstractDamping):
    """Kelvin-Voigt damping D = time K of the rod's linear stiffness K.

    Attributes:
        time: Retardation time, viscosity over modulus [s].
    """

    time: Float[Array, ""] = eqx.field(converter=real)

    def matrix(self, stiffness):
        return self.time * stiffness


class Relaxation(AbstractForce):
    """Maxwell branches beside the elasticity of a rod, of the spectrum of its material.

    Branch i bears K_i (q - z_i) with dz_i/dt = (q - z_i) / tau_i and remembers z_i. Beside the
    rod's own stiffness K, torsion and shear relax by the shear modulus, K_i = g_i K, bending
    and stretch by Young's modulus, whose shares and times `material.uniaxial_spectrum` gives
    from those of the shear modulus and Poisson's ratio, as in a solid of constant bulk
    modulus. Beside an `AbstractElastic` K is the slope of that law at q = 0, and all of it
    relaxes by the shear modulus: exact for a Poisson's ratio nu of 0.5; otherwise the
    instantaneous stiffness in bending is too large by a share (1 - 2 nu) / 3 of the sum of g_i.

    `rod.rollout`, `systems.RodBody` and `systems.AssemblyBody` carry z_i along and begin
    relaxed; `equilibrium`, paths of it and `inverse_kinematics` have all the time there is
    and leave the branches out. Elsewhere it is refused.

    Attributes:
        spectrum: Of the shear modulus, one number for each constant: that of
            `material.Viscoelastic`.

    Reference:
        Simo and Hughes, Computational Inelasticity, 1998, chapter 10, for the branches.
    """

    spectrum: Prony

    def __check_init__(self):
        if not isinstance(self.spectrum, Prony):
            raise TypeError(
                f"Relaxation: `spectrum` is a {type(self.spectrum).__name__}, need a spectrum. "
                "Write material.Prony(shares, times)."
            )
        do = "A rod has one spectrum: give one number per branch."
        for name in ("shares", "times"):
            for entry in getattr(self.spectrum, name):
                _check.shape("Relaxation", name, entry, (), do)

    def __call__(self, t, motion):
        raise ValueError(
            "rod: got a Relaxation where no branch remembers the motion, need a verb that "
            "carries its memory: rollout, RodBody or AssemblyBody; equilibrium leaves it out. "
            "Take it off the forces here, or add branch_force(model, forces, q, memory)."
        )


class Gravity(AbstractForce):
    """Weight of the rod.

    Attributes:
        acceleration: [m/s^2] in the base frame; by default 9.81 against the last axis.
    """

    acceleration: Float[Array, " dim"] | None = eqx.field(converter=optional_real, default=None)

    def __call__(self, t, motion):
        g = gravity_or_earth(self.acceleration, motion.tangent.shape[1], motion.q.dtype)
        loads = motion.operators.mass[:, None] * g[None, :]
        return loads.reshape(-1) @ mass_jacobian(motion).reshape(-1, motion.q.shape[0])


class TipWrench(AbstractForce):
    """A dead wrench on the last section: its world components never turn.

    `PointWrench` and `LineWrench` act elsewhere, or turn with the section.

    Attributes:
        wrench: Moment [N m], then force [N]: (m_z, f_x, f_y) for a planar rod.
    """

    wrench: Float[Array, " twist"] = eqx.field(converter=real)

    def __call__(self, t, motion):
        return self.wrench @ motion.tip_jacobian


class Pressurised(AbstractForce):
    """A pressure map, `chamber`, at a given gauge `pressure` [Pa], scalar or one per port."""

    chamber: AbstractPressureMap
    pressure: Float[Array, "*ports"] = eqx.field(converter=real)

    def __call__(self, t, motion):
        force = jax.grad(self.chamber.coenergy)(own(motion, motion.q), self.pressure)
        return from_own(motion, force)


def total_force(
    forces: tuple[AbstractForce, ...], t: Float[Array, ""], motion: RodState
) -> Float[Array, " dof"]:
    """Sum of the listed forces and of the rod's elasticity if none replaces it."""
    unbound = [type(f).__name__ for f in forces if isinstance(f, AbstractPressureMap)]
    if unbound:
        raise ValueError(
            f"rod: the pressure map {unbound[0]} has no pressure. Wrap it, "
            "Pressurised(map, 10 * kPa), or list it in a RodBody and wire its pressure."
        )
    terms = []
    if not any(isinstance(force, AbstractElastic) for force in forces):
        terms.append(-from_own(motion, motion.operators.stiffness @ own(motion, motion.q)))
    return functools.reduce(jnp.add, terms + [force(t, motion) for force in forces])


def tangent_stiffness(
    forces: tuple[AbstractForce, ...], motion: RodState
) -> Float[Array, "dof dof"]:
    """Elastic stiffness at the coordinates of `motion`, replaced laws included."""
    q, laws = own(motion, motion.q), [f for f in forces if isinstance(f, AbstractElastic)]
    slopes = [jax.jacfwd(law.restoring_force)(q) for law in laws]
    return functools.reduce(jnp.add, slopes) if slopes else motion.operators.stiffness


def damping_matrix(
    forces: tuple[AbstractForce, ...], stiffness: Float[Array, "dof dof"]
) -> Float[Array, "dof dof"]:
    """Sum of the listed dampings; zeros without one."""
    listed = [f.matrix(stiffness) for f in forces if isinstance(f, AbstractDamping)]
    return functools.reduce(jnp.add, listed) if listed else jnp.zeros_like(stiffness)


def gravity_or_earth(acceleration: Array | None, dim: int, dtype: Any) -> Float[Array, " dim"]:
    if acceleration is not None:
        return acceleration
    return jnp.array([0.0] * (dim - 1) + [-EARTH], dtype)


# A nonlinear law of the section: moments and forces from strains, by a user function


class SectionLaw(AbstractElastic):
    """Elasticity from a function of the strain of the section, from `section_law`.

    Attributes:
        stress: (strain change, s) -> moments [N m], then forces [N].
        rows: Strain per coordinate at the Gauss nodes.
        weights: Gauss weights [m].
        s: The nodes in [0, 1].
    """

    stress: Callable[[Float[Array, " strain"], Float[Array, ""]], Float[Array, " strain"]]
    rows: Float[Array, "quad strain dof"]
    weights: Float[Array, " quad"]
    s: Float[Array, " quad"]

    def restoring_force(self, q):
        stress = jax.vmap(self.stress)(self.rows @ q, self.s)
        do = "Return one moment or force per strain of the rod."
        _check.shape("SectionLaw", "stress", stress, self.rows.shape[:2], do)
        loads = (self.weights[:, None] * stress).reshape(-1)
        return loads @ self.rows.reshape(-1, q.shape[0])


def section_law(
    rod: Rod,
    stress: Callable[[Float[Array, " strain"], Float[Array, ""]], Float[Array, " strain"]],
) -> SectionLaw:
    """An elastic law for `rod` in place of its linear one.

    Args:
        rod: The rod; build the law again where it changes.
        stress: (strain beyond that at rest, s) -> moments [N m] and forces [N], both in the
            order of `strain_names(rod.group)`. The gradient of an energy per length keeps
            energy.

    Returns:
        The law, one of the forces of `equilibrium` or `rollout`.
    """
    s = jnp.asarray(gauss_legendre(rod.quadrature)[0], rod.length.dtype)
    return SectionLaw(stress, *_rows(rod), s)


@once
def _rows(rod: Rod) -> tuple[Array, Array]:
    """Strain per coordinate at the Gauss nodes, and their weights [m]."""
    return strains_at(rod)[1], operators(rod).weights


class EnergyLaw(eqx.Module):
    """The stress of an `energy` per length [J/m], a function of (strain, s)."""

    energy: Callable[[Float[Array, " strain"], Float[Array, ""]], Float[Array, ""]]

    def __call__(self, strain: Float[Array, " strain"], s: Float[Array, ""]) -> Array:
        return jax.grad(self.energy)(strain, s)


class PointWrench(AbstractForce):
    """A wrench on the section at `s`.

    Attributes:
        wrench: Moment [N m], then force [N]: (m_z, f_x, f_y) for a planar rod.
        s: Where, in [0, 1].
        follower: Whether the components turn with the section; otherwise it is dead.
    """

    wrench: Float[Array, " twist"] = eqx.field(converter=real)
    s: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    follower: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        _check.between("PointWrench", "s", self.s, 0, 1, "-", "0 is the base.", "[]")

    def __call__(self, t, motion):
        _check_wrench("PointWrench", self.wrench, motion)
        at = points(motion, self.s[None])
        return _apply(at, self.wrench[None], self.follower)


def _density(value: Any) -> Any:
    return value if callable(value) else real(value)


class LineWrench(AbstractForce):
    """A wrench per length of the unstrained rod.

    Attributes:
        wrench: Moment [N], then force [N/m], constant or a function of s in [0, 1].
        follower: Whether the components turn with the sections; otherwise it is dead.
    """

    wrench: Float[Array, " twist"] | Callable[[Array], Array] = eqx.field(converter=_density)
    follower: bool = eqx.field(static=True, default=False)

    def __call__(self, t, motion):
        s = jnp.asarray(gauss_legendre(motion.rod.quadrature)[0], motion.q.dtype)
        if callable(self.wrench):
            loads = jax.vmap(self.wrench)(s)
        else:
            loads = jnp.broadcast_to(self.wrench, (s.shape[0], *self.wrench.shape))
        _check_wrench("LineWrench", loads[0], motion)
        return _apply(nodes(motion), motion.operators.weights[:, None] * loads, self.follower)


def _apply(at: Points, loads: Float[Array, "points twist"], follower: bool) -> Array:
    rot = at.motion.angular_rate.shape[1]
    moment, force = loads[:, :rot], loads[:, rot:]
    if follower:
        axes = at.directors
        force = jnp.sum(axes * force[:, None, :], axis=2)
        if rot == 3:
            moment = jnp.sum(axes * moment[:, None, :], axis=2)
    return at.generalised(force, moment)


def _check_wrench(where: str, wrench, motion: RodState) -> None:
    size = motion.angular_rate.shape[1] + motion.tangent.shape[1]
    do = "Give the moment, then the force; a planar rod takes (m_z, f_x, f_y)."
    _check.shape(where, "wrench", wrench, (size,), do)


# A fluid around a rod: buoyancy and drag


class Buoyancy(AbstractForce):
    """Weight of the displaced fluid, upwards.

    Attributes:
        density: Of the fluid [kg/m^3].
        acceleration: Of gravity [m/s^2]; by default 9.81 against the last axis.
    """

    density: Float[Array, ""] = eqx.field(converter=real)
    acceleration: Float[Array, " dim"] | None = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        _check.positive("Buoyancy", "density", self.density, "kg/m^3", "Water has 1000.")

    def __call__(self, t, motion):
        g = gravity_or_earth(self.acceleration, motion.tangent.shape[1], motion.q.dtype)
        volume = motion.operators.mass / motion.rod.material.density
        loads = -self.density * volume[:, None] * g[None, :]
        return loads.reshape(-1) @ motion.linear_jacobian.reshape(-1, motion.q.shape[0])


class Drag(AbstractForce):
    """Resistance of a fluid, per length, across and along the rod.

    Quadratic: density * diameter * C |v| v / 2 with each part of the velocity, the
    coefficient along the rod taken on the circumference; linear: `viscous` times the
    velocity. In a fluid at rest every part takes energy from the rod.

    Attributes:
        density: Of the fluid [kg/m^3].
        diameter: Width of the rod [m].
        across: Drag coefficient of the velocity across the rod [-].
        along: Friction coefficient of the velocity along it, about 0.01 [-].
        viscous: Linear coefficient [N s/m^2]; None costs nothing.
        flow: Velocity of the fluid [m/s]; at rest if None.

    Reference:
        Taylor, Analysis of the swimming of long and narrow animals, Proc. R. Soc. A 214,
        1952, for the split into both parts.
    """

    density: Float[Array, ""] = eqx.field(converter=real)
    diameter: Float[Array, "*quad"] = eqx.field(converter=real)
    across: Float[Array, ""] = eqx.field(converter=real, default=1.1)
    along: Float[Array, ""] = eqx.field(converter=real, default=0.01)
    viscous: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    flow: Float[Array, " dim"] | None = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        _check.positive("Drag", "density", self.density, "kg/m^3", "Water has 1000.")
        _check.positive("Drag", "diameter", self.diameter, "m", "Give the width of the rod.")

    def __call__(self, t, motion):
        at = nodes(motion)
        velocity = at.velocity
        if self.flow is not None:
            velocity = velocity - self.flow[None]
        stretch = safe_norm(motion.tangent)[:, None]
        axis = motion.tangent / stretch
        lengthwise = jnp.sum(axis * velocity, axis=1, keepdims=True) * axis
        crosswise = velocity - lengthwise
        width = self.density * jnp.broadcast_to(self.diameter, stretch.shape[:1])[:, None] / 2
        force = self.across * safe_norm(crosswise)[:, None] * crosswise
        force = force + jnp.pi * self.along * safe_norm(lengthwise)[:, None] * lengthwise
        force = width * force
        if self.viscous is not None:
            force = force + self.viscous * velocity
        return -at.generalised(motion.operators.weights[:, None] * stretch * force)
