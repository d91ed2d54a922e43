"""Rods with the stiffness, chambers and mass of cells, alone or side by side."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.jit import once
from sorojax._types import real
from sorojax.material import AbstractHyperelastic
from sorojax.math.lie import SE2, SE3
from sorojax.reduction.identify import ConstantDamping
from sorojax.robots.models.cell import Cell
from sorojax.robots.models.grid import covered
from sorojax.rod import (
    AbstractPressureMap,
    LinearElastic,
    Link,
    Rod,
    Section,
    StrainBasis,
    elastic,
    operators,
    rod,
    strain_names,
)
from sorojax.sdf import AbstractSdf


class Bundle(eqx.Module):
    """Columns of equal cells between two rigid ends, as one section; see `Cell`.

    Attributes:
        stiffness: Of the strains (e, k1, k2) of the middle.
        shear: Force per shear strain along y and z [N]; None of a single column, which the
            basis of its rod keeps from shearing.
        push: Of each chamber.
        gas, compliance: Of each chamber, per length.
        solid, second_moments: Of all columns.
        arms: Stretch of each column per strain of the middle.
        third, fourth: Of each column, as in `Cell`; None where the answer is linear.
    """

    stiffness: Float[Array, "3 3"]
    push: Float[Array, "ports 3"]
    gas: Float[Array, " ports"]
    compliance: Float[Array, " ports"]
    solid: Float[Array, ""]
    second_moments: Float[Array, "2"]
    arms: Float[Array, "ports 3"]
    shear: Float[Array, "2"] | None = None
    third: Float[Array, "4"] | None = None
    fourth: Float[Array, "5"] | None = None


def column(cell: Cell) -> Bundle:
    """One column, with linear answers."""
    return Bundle(
        cell.stiffness,
        cell.push[None],
        cell.gas[None],
        cell.compliance[None],
        cell.solid,
        cell.second_moments,
        jnp.eye(1, 3, dtype=cell.push.dtype),
    )


def side_by_side(cell: Cell, places: Float[Array, "columns 2"], length) -> Bundle:
    """Columns at `places` (y, z) [m] that are `length` [m] long and clamped at both ends.

    All have the curvature of the middle, and its strain at their place. A shift of one end
    bends each column to an S: 12 EI / L^2 per column, exact for ends that alone are loaded.
    Large stretches and pressures count along the columns, not in how these bend.
    """
    places, count = real(places), len(places)
    rows = jnp.zeros((count, 3, 3), places.dtype).at[:].set(jnp.eye(3, dtype=places.dtype))
    rows = rows.at[:, 0, 1:].set(places)
    bending = jnp.diag(cell.stiffness)[1:]
    square = jnp.sum(places**2, axis=0)
    return Bundle(
        stiffness=jnp.einsum("cia,ij,cjb->ab", rows, cell.stiffness, rows),
        push=jnp.einsum("i,cia->ca", cell.push, rows),
        gas=jnp.broadcast_to(cell.gas, (count,)),
        compliance=jnp.broadcast_to(cell.compliance, (count,)),
        solid=count * cell.solid,
        second_moments=count * cell.second_moments + cell.solid * square,
        arms=rows[:, 0],
        shear=count * 12 * bending / real(length) ** 2,
        third=cell.third,
        fourth=cell.fourth,
    )


class Stretched(eqx.Module):
    """Energy of columns beyond the linear response, at the nodes of a rod.

    Attributes:
        rows: Stretch of each column per coordinate, at every node.
        weights: Of the nodes [m].
        coefficients: Of stretch^i pressure^j in the energy per length less pressure times
            area.
    """

    rows: Float[Array, "ports nodes dof"]
    weights: Float[Array, " nodes"]
    coefficients: Float[Array, "5 5"]

    def energy(self, q, pressure) -> Array:
        """Less pressure times volume [J]."""
        sums = _powers(self.rows @ q) @ self.weights
        return jnp.sum(sums * (self.coefficients @ _powers(pressure)))


def _powers(x: Array) -> Array:
    square = x * x
    return jnp.stack([jnp.ones_like(x), x, square, square * x, square * square])


def _coefficients(third: Float[Array, "4"], fourth: Float[Array, "5"]) -> Array:
    """Of the powers, from the derivatives of a `Cell`."""
    places = [(order - k, k) for order in (3, 4) for k in range(order + 1)]
    scale = [math.factorial(i) * math.factorial(j) for i, j in places]
    values = jnp.concatenate([third, fourth]) / np.array(scale, third.dtype)
    return jnp.zeros((5, 5), values.dtype).at[*np.array(places).T].set(values)


class Chambers(AbstractPressureMap):
    """Gas in the cells of a rod: W = p . (volume + push q) + compliance p^2 / 2, and what
    large stretches and pressures take from it.

    Attributes:
        push: Change of volume per coordinate.
        rest: Volume at rest [m^3].
        compliance: Of the walls at held strain [m^3/Pa].
        beyond: None where the answer is linear.
    """

    push: Float[Array, "ports dof"]
    rest: Float[Array, " ports"]
    compliance: Float[Array, " ports"]
    ports: tuple[int, ...] = eqx.field(static=True)
    beyond: Stretched | None = None

    def coenergy(self, q, pressure):
        p = jnp.atleast_1d(pressure)
        linear = p @ (self.rest + self.push @ q) + jnp.sum(self.compliance * p**2) / 2
        return linear if self.beyond is None else linear - self.beyond.energy(q, p)


class Body(NamedTuple):
    """A rod, its elasticity and damping, and its chambers."""

    rod: Rod
    forces: tuple[LinearElastic, ConstantDamping]
    chambers: Chambers


def body(
    group: Any,
    basis: StrainBasis,
    bundle: Bundle,
    length,
    material: AbstractHyperelastic,
    *,
    damping,
    plane: int = 1,
    single: bool = True,
) -> Body:
    """A rod along the axis of `bundle` with everything that its cells answer.

    Args:
        group: `SE3()`, or `SE2()` to bend in one plane.
        basis: Active strains.
        bundle: Its section.
        length: [m].
        material: Of the solid, for its density.
        damping: Retardation time of the solid, viscosity over modulus [s].
        plane: Lateral axis of the cells in whose direction an `SE2()` rod bends.
        single: Whether a bundle of one chamber has a scalar port.

    Raises:
        ValueError: If there is no length left, or `damping` is not finite.
    """
    do = "Make the robot longer, or the ends in which it is held shorter."
    _check.positive("robots.model", "length", length, "m", do)
    _check.finite("robots.model", "damping", damping, "Give a time in seconds: 3e-3.")
    return _body(group, basis, bundle, real(length), material, real(damping), plane, single)


@once
def _body(group, basis, bundle, length, material, damping, plane, single) -> Body:
    y, z = bundle.second_moments[plane - 1], bundle.second_moments[2 - plane]
    # elasticity is given below; of the section only what carries mass counts
    section = Section(bundle.solid, z, y, y + z)
    made = rod(group, basis, section, elastic(material), length=length)
    constants = operators(made)
    turn = _turn(group, plane)
    shear = jnp.zeros(2) if bundle.shear is None else bundle.shear
    law = turn.T @ jnp.asarray(_blocks(bundle.stiffness, shear)) @ turn
    names = strain_names(made.group)
    at = np.array([names.index(name) for name in made.basis.active])
    rows, weights = constants.strain_rows, constants.weights
    stiffness = jnp.einsum("aqi,ab,bqj,q->ij", rows, law[np.ix_(at, at)], rows, weights)
    push = jnp.einsum("pb,bqj,q->pj", bundle.push @ turn[:3][:, at], rows, weights)
    ports = () if single and len(bundle.gas) == 1 else (len(bundle.gas),)
    beyond = None
    if bundle.third is not None and bundle.fourth is not None:
        along = jnp.einsum("pb,bqj->pqj", bundle.arms @ turn[:3][:, at], rows)
        beyond = Stretched(along, weights, _coefficients(bundle.third, bundle.fourth))
    chambers = Chambers(
        push=push,
        rest=length * bundle.gas,
        compliance=length * bundle.compliance,
        ports=ports,
        beyond=beyond,
    )
    lossy = ConstantDamping(damping * stiffness)
    return Body(made, (LinearElastic(stiffness), lossy), chambers)


def _turn(group: Any, plane: int) -> np.ndarray:
    """(e, k1, k2, shear along y, along z) of a cell from the strains of a rod."""
    if isinstance(group, SE3):
        entries = {(0, 3): 1, (1, 2): -1, (2, 1): 1, (3, 4): 1, (4, 5): 1}
    else:
        assert isinstance(group, SE2)
        entries = {(0, 1): 1, (plane, 0): -1, (2 + plane, 2): 1}
    turn = np.zeros((5, len(strain_names(group))))
    for place, value in entries.items():
        turn[place] = value
    return turn


def _blocks(stiffness: Array, shear: Array) -> Array:
    return jnp.zeros((5, 5)).at[:3, :3].set(stiffness).at[3:, 3:].set(jnp.diag(shear))


def rigid(shape: AbstractSdf, origin, axes, density, *, resolution: int = 64) -> Link:
    """The stiff part, as a link.

    Args:
        shape: The solid.
        origin: Of the frame of the link in the drawing [m].
        axes: Its axes there, as columns.
        density: [kg/m^3].
        resolution: Samples along its longest side.
    """
    lower, upper = (np.asarray(corner) for corner in shape.bounding_box())
    edge = float(np.max(upper - lower)) / resolution
    lines = [np.arange(a + edge / 2, b, edge) for a, b in zip(lower, upper, strict=True)]
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    masses = float(density) * edge**3 * covered(shape, points, edge)
    center = masses @ points / masses.sum()
    arms = points - center
    inertia = np.sum(masses * np.sum(arms**2, axis=1)) * np.eye(3) - (masses * arms.T) @ arms
    place = center - np.asarray(origin)
    return Link(masses.sum(), axes.T @ inertia @ axes, axes.T @ place)
