"""How the displacement of a mesh becomes a deformation gradient in three dimensions.

A kinematics keeps the entries of F that can differ from those of the identity, as a flat
tuple; the rest of F is known when the kernels are traced, and costs nothing.
"""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.material.hyperelastic import AbstractHyperelastic
from sorojax.material.kinematics import Entry, Tensor

Gradient = tuple[Entry, ...]


class Slot(NamedTuple):
    """Entry F[row][col] is the slope of displacement `component` along `column`."""

    component: int
    column: int
    row: int
    col: int


def _square(dim: int) -> tuple[Slot, ...]:
    return tuple(Slot(i, j, i, j) for i in range(dim) for j in range(dim))


class AbstractKinematics(eqx.Module):
    """Completes the entries of F that a mesh determines."""

    dim: eqx.AbstractClassVar[int]
    slots: eqx.AbstractClassVar[tuple[Slot, ...]]
    num_columns: eqx.AbstractClassVar[int]
    has_volume: eqx.AbstractClassVar[bool]

    @abc.abstractmethod
    def embed(self, F: Gradient) -> Tensor:
        """F in three dimensions, as far as the mesh determines it."""

    @abc.abstractmethod
    def depth(self, position: tuple[Entry, ...]) -> Entry:
        """Length out of the mesh at a point: thickness, circumference or one."""

    def shape_energy(self, material: AbstractHyperelastic, F: Gradient) -> Entry:
        """Energy per reference volume that is not a function of J alone [J/m^3]."""
        return material.isochoric_energy(self.embed(F))


class PlaneStrain(AbstractKinematics):
    """No strain out of the plane; forces are those of a body `thickness` deep [m]."""

    thickness: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    dim: ClassVar[int] = 2
    slots: ClassVar[tuple[Slot, ...]] = _square(2)
    num_columns: ClassVar[int] = 2
    has_volume: ClassVar[bool] = True

    def __check_init__(self):
        _check_thickness("PlaneStrain", self.thickness)

    def embed(self, F: Gradient) -> Tensor:
        a, b, c, d = F
        return ((a, b, 0.0), (c, d, 0.0), (0.0, 0.0, 1.0))

    def depth(self, position) -> Entry:
        return self.thickness


class PlaneStress(AbstractKinematics):
    """A sheet `thickness` thin [m] that is free to contract out of its plane.

    The stretch out of the plane makes the energy of every point least. It is found by
    Newton's method, and the last step carries its first derivative. As the energy is least,
    its derivatives up to the third are those of plane stress: stress, tangent, and what both
    change by with any number. Do not differentiate a stress twice.
    """

    thickness: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    dim: ClassVar[int] = 2
    slots: ClassVar[tuple[Slot, ...]] = _square(2)
    num_columns: ClassVar[int] = 2
    has_volume: ClassVar[bool] = False

    def __check_init__(self):
        _check_thickness("PlaneStress", self.thickness)

    def embed(self, F: Gradient) -> Tensor:
        a, b, c, d = F
        return ((a, b, 0.0), (c, d, 0.0), (0.0, 0.0, 1.0))

    def depth(self, position) -> Entry:
        return self.thickness

    def shape_energy(self, material: AbstractHyperelastic, F: Gradient) -> Entry:
        return _sheet_energy(material, F, self.thickness_stretch(material, F))

    def thickness_stretch(self, material: AbstractHyperelastic, F: Gradient) -> Entry:
        """Stretch out of the plane at which the stress out of the plane vanishes."""
        held = jax.lax.stop_gradient((material, F))
        J = held[1][0] * held[1][3] - held[1][1] * held[1][2]
        start = -0.5 * jnp.log(J)

        def improve(_, log_stretch):
            step = _thickness_step(*held, log_stretch)
            return log_stretch + jnp.clip(step, -0.5, 0.5)

        found = jax.lax.fori_loop(0, _SHEET_ITERATIONS, improve, start)
        return jnp.exp(found + _thickness_step(material, F, jax.lax.stop_gradient(found)))


_SHEET_ITERATIONS = 9


def _sheet_energy(material: AbstractHyperelastic, F: Gradient, stretch: Entry) -> Entry:
    a, b, c, d = F
    full = ((a, b, 0.0), (c, d, 0.0), (0.0, 0.0, stretch))
    return material.isochoric_energy(full) + material.volumetric_energy(
        (a * d - b * c) * stretch
    )


def _thickness_step(material, F: Gradient, log_stretch: Entry) -> Entry:
    """Newton step for the logarithm of the stretch out of the plane."""

    def slope(s):
        return jax.grad(lambda s: jnp.sum(_sheet_energy(material, F, jnp.exp(s))))(s)

    value, rate = jax.jvp(slope, (log_stretch,), (jnp.ones_like(log_stretch),))
    return -value / jax.lax.stop_gradient(rate)


class Axisymmetric(AbstractKinematics):
    """A body of revolution about the y axis: x is the radius; forces are those of the
    whole body."""

    dim: ClassVar[int] = 2
    slots: ClassVar[tuple[Slot, ...]] = (*_square(2), Slot(0, 2, 2, 2))
    num_columns: ClassVar[int] = 3
    has_volume: ClassVar[bool] = True

    def embed(self, F: Gradient) -> Tensor:
        a, b, c, d, hoop = F
        return ((a, b, 0.0), (c, d, 0.0), (0.0, 0.0, hoop))

    def depth(self, position) -> Entry:
        return 2 * jnp.pi * position[0]


class Solid(AbstractKinematics):
    """A body in space."""

    dim: ClassVar[int] = 3
    slots: ClassVar[tuple[Slot, ...]] = _square(3)
    num_columns: ClassVar[int] = 3
    has_volume: ClassVar[bool] = True

    def embed(self, F: Gradient) -> Tensor:
        return (F[:3], F[3:6], F[6:])  # type: ignore[return-value]

    def depth(self, position) -> Entry:
        return jnp.ones((), jnp.result_type(*position))


def _check_thickness(where: str, thickness) -> None:
    _check.positive(where, "thickness", thickness, "m", "Write 20 * mm, for example.")


def identity(kinematics: AbstractKinematics) -> tuple[float, ...]:
    """The kept entries of F at rest."""
    return tuple(float(s.row == s.col) for s in kinematics.slots)


def strain_pairs(
    kinematics: AbstractKinematics | type[AbstractKinematics],
) -> list[tuple[int, int]]:
    """Entries (j, k), j <= k, of F'F that may differ from those of the identity."""
    slots = kinematics.slots
    pairs = {(a.col, b.col) for a in slots for b in slots if a.row == b.row}
    return sorted((j, k) for j, k in pairs if j <= k)


def green_rates(
    kinematics: AbstractKinematics,
    F: Float[Array, "entries ..."],
    H: Float[Array, "entries ..."],
) -> list[Float[Array, "..."]]:
    """Entries of (F'H + H'F) / 2 in `strain_pairs`: rates of the Green strain for `H` of F."""
    at = {(s.row, s.col): number for number, s in enumerate(kinematics.slots)}

    def entry(j, k):
        rows = [r for r in range(3) if (r, j) in at and (r, k) in at]
        both = [F[at[r, j]] * H[at[r, k]] + F[at[r, k]] * H[at[r, j]] for r in rows]
        return 0.5 * sum(both[1:], start=both[0])

    return [entry(j, k) for j, k in strain_pairs(kinematics)]


def component_pairs(dim: int) -> list[tuple[int, int]]:
    return [(i, k) for i in range(dim) for k in range(i, dim)]


def entries_of(kinematics: AbstractKinematics, component: int) -> list[tuple[int, int]]:
    """Kept entries of F in one row and the columns of the gradients they take."""
    slots = enumerate(kinematics.slots)
    return [(e, s.column) for e, s in slots if s.component == component]
