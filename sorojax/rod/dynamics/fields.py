"""The state of a rod as forces and inertia read it: constants, and fields at one time."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.math.lie import FROM_MOMENTS
from sorojax.math.linalg.dense import product
from sorojax.math.quadrature import gauss_legendre, integration_matrix, interpolation_rows
from sorojax.rod.model.basis import STRAINS
from sorojax.rod.model.rod import Rod, strain_names
from sorojax.rod.model.section import Section

_CELL_POINTS = 12


class Operators(NamedTuple):
    """Constant arrays of one rod, assembled once before a loop.

    Attributes:
        weights: Gauss weights [m].
        integration: Integrals from the base to each node [m].
        strain_rows: Strain per coordinate, one block per active strain.
        moments: What the rotations of the cells between nodes (and breaks) read of the
            curvature, one block per component, per coordinate: the three coefficients of
            their Magnus expansion, in the plane the angle [rad].
        rest_moments: The same of the rest curvature.
        rest_strain: Strain at q = 0, curvatures first; one column per node if it varies.
        mass: Mass lumped at each node [kg].
        rotary: Rotary inertia lumped at each node, about x, y, z (planar: z) [kg m^2].
        stiffness: Linear elastic stiffness.
        mass_offset: From the centre line to the centre of mass along the local axes across
            it [m]; None where the mass lies on the line.
    """

    weights: Float[Array, " quad"]
    integration: Float[Array, "quad quad"]
    strain_rows: Float[Array, "active quad dof"]
    moments: Float[Array, "order rot cells dof"]
    rest_moments: Float[Array, "order rot cells"]
    rest_strain: Float[Array, "strain *quad"]
    mass: Float[Array, " quad"]
    rotary: Float[Array, "rot quad"]
    stiffness: Float[Array, "dof dof"]
    mass_offset: Float[Array, "across quad"] | None = None


class Base(eqx.Module):
    """Frame on which a rod or a link starts.

    Attributes:
        directors: Columns are its axes.
        position: Of its origin [m].
        angular_jacobian, linear_jacobian: Its velocities per rate, in the columns of a motion.
    """

    directors: Float[Array, "dim dim"]
    position: Float[Array, " dim"]
    angular_jacobian: Float[Array, "rot dof"]
    linear_jacobian: Float[Array, "dim dof"]


class RodState(eqx.Module):
    """A rod at one moment: coordinates, and fields at the Gauss nodes, world frame.

    What a force does not read is never computed. An integral along the rod is
    `operators.weights @ field`: a pose or Jacobian at s is that of the base, plus the
    integral of the rates from the base to s.

    On a moving base the columns of the Jacobians are the twist of the base (its own axes,
    angular first), then the coordinates of the rod; q is zero in the columns of the base.

    Attributes:
        rod: The rod.
        operators: Its constants.
        q, v: Coordinates and their rates, one per column.
        directors: Columns are the local axes of the section.
        tangent: d position / ds [-].
        angular_rate: d angular Jacobian / ds.
        linear_rate: d linear Jacobian / ds.
        angular_jacobian: Angular velocity per rate (planar: about z).
        linear_jacobian: Velocity of the section centre per rate.
        base: Where the rod starts; None for a clamp at the origin.
    """

    rod: Rod
    operators: Operators
    q: Float[Array, " dof"]
    v: Float[Array, " dof"]
    directors: Float[Array, "quad dim dim"]
    tangent: Float[Array, "quad dim"]
    angular_rate: Float[Array, "quad rot dof"]
    linear_rate: Float[Array, "quad dim dof"]
    angular_jacobian: Float[Array, "quad rot dof"]
    linear_jacobian: Float[Array, "quad dim dof"]
    base: Base | None = None

    @property
    def position(self) -> Float[Array, "quad dim"]:
        """Centres of the sections [m]."""
        path = integrated(self.operators, self.tangent)
        return path if self.base is None else path + self.base.position[None, :]

    @property
    def tip_jacobian(self) -> Float[Array, "twist dof"]:
        """Twist of the tip per rate: angular velocity first, world frame."""
        weights = self.operators.weights
        angular = jnp.tensordot(weights, self.angular_rate, 1)
        linear = jnp.tensordot(weights, self.linear_rate, 1)
        if self.base is not None:
            angular = angular + self.base.angular_jacobian
            linear = linear + self.base.linear_jacobian
        return jnp.concatenate([angular, linear])


def operators(rod: Rod) -> Operators:
    """The constant arrays of `rod`; differentiable in all its leaves."""
    dtype, length, rule = rod.length.dtype, rod.length, rod.quadrature
    nodes, weights = gauss_legendre(rule)
    rows, weights = jnp.asarray(rod.basis(nodes), dtype), jnp.asarray(weights, dtype)
    rotary = _rotary(rod)
    return Operators(
        weights=length * weights,
        integration=length * jnp.asarray(integration_matrix(rule), dtype),
        strain_rows=rows,
        moments=length * _moments(rod, dtype),
        rest_moments=length * _rest_moments(rod, dtype),
        rest_strain=_rest_strain(rod, dtype),
        mass=length * weights * _along(rod, rod.material.density * _carrying(rod).area),
        rotary=length * weights[None, :] * rotary,
        stiffness=_stiffness(rod, rows, weights),
        mass_offset=_mass_offset(rod),
    )


def integrated(
    constants: Operators, rate: Float[Array, "quad *shape"]
) -> Float[Array, "quad *shape"]:
    """Integrals from the base to each node; for few columns."""
    return product(constants.integration, rate.reshape(rate.shape[0], -1)).reshape(rate.shape)


def _along(rod: Rod, value: Array) -> Float[Array, " quad"]:
    return jnp.broadcast_to(value, (rod.nodes,))


def rest_along(constants: Operators) -> Float[Array, "#quad strain"]:
    """Strain at q = 0 at the nodes, one row if it is constant."""
    rest = constants.rest_strain
    return rest[None] if rest.ndim == 1 else rest.T


def strains_at(
    rod: Rod, s: Float[Array, " points"] | np.ndarray | None = None
) -> tuple[Float[Array, "#points strain"], Float[Array, "points strain dof"]]:
    """Rest strain, one row if it is constant, and strain per coordinate at `s`, by default at
    the nodes."""
    constants, dtype = operators(rod), rod.length.dtype
    rest, rows = rest_along(constants), constants.strain_rows
    if s is not None:
        rows = jnp.asarray(rod.basis(s), dtype)
        if rest.shape[0] > 1:
            rest = jnp.asarray(interpolation_rows(rod.quadrature, s), dtype) @ rest
    active = dict(zip(rod.basis.active, rows, strict=True))
    none = jnp.zeros(rows.shape[1:], dtype)
    return rest, jnp.stack([active.get(name, none) for name in strain_names(rod.group)], axis=1)


def _rest_strain(rod: Rod, dtype) -> Float[Array, "strain *quad"]:
    if rod.rest_strain is not None:
        return rod.rest_strain
    straight = [float(name == "sigma_x") for name in strain_names(rod.group)]
    return jnp.array(straight, dtype)


def _carrying(rod: Rod) -> Section:
    """The section by which the rod carries mass."""
    return rod.section if rod.mass_section is None else rod.mass_section


def _rotary(rod: Rod) -> Float[Array, "rot quad"]:
    """Rotary inertia per length about the centres of mass [kg m]."""
    section, density = _carrying(rod), rod.material.density
    about_y, about_z = section.second_moment_y, section.second_moment_z
    if section.mass_offset_z is not None:
        about_y = about_y - section.area * section.mass_offset_z**2
    if section.mass_offset_y is not None:
        about_z = about_z - section.area * section.mass_offset_y**2
    spatial = rod.group.rotation_dim == 3
    about = (about_y + about_z, about_y, about_z) if spatial else (about_z,)
    return jnp.stack([_along(rod, density * moment) for moment in about])


def _mass_offset(rod: Rod) -> Float[Array, "across quad"] | None:
    section = _carrying(rod)
    offsets = [section.mass_offset_y, section.mass_offset_z][: rod.group.space_dim - 1]
    if all(offset is None for offset in offsets):
        return None
    none = jnp.zeros((), rod.length.dtype)
    return jnp.stack([_along(rod, none if offset is None else offset) for offset in offsets])


def rigidities(rod: Rod) -> dict[str, Float[Array, " quad"]]:
    """Stiffness of the section at the nodes by strain: N m^2 of curvatures, N of others."""
    section, young = rod.section, rod.material.young_modulus
    shear = young / (2 * (1 + rod.material.poisson_ratio))
    along_z = section.shear_factor if section.shear_factor_z is None else section.shear_factor_z
    every = {
        "kappa_x": shear * section.torsion_constant,
        "kappa_y": young * section.second_moment_y,
        "kappa_z": young * section.second_moment_z,
        "sigma_x": young * section.area,
        "sigma_y": shear * section.shear_factor * section.area,
        "sigma_z": shear * along_z * section.area,
    }
    return {name: _along(rod, value) for name, value in every.items()}


def _stiffness(rod: Rod, rows: Array, weights: Array) -> Float[Array, "dof dof"]:
    every = rigidities(rod)
    scale = jnp.stack([every[name] for name in rod.basis.active])
    scale = rod.length * scale * weights[None, :]
    return jnp.einsum("aqm,aq,aqn->mn", rows, scale, rows)


def _cells(rod: Rod) -> tuple[np.ndarray, np.ndarray]:
    """Points of the cells that end at the nodes and breaks, (cells, points), and their
    weights in the moments, (order, cells, points), unit length."""
    x, w = gauss_legendre(_CELL_POINTS)
    ends = rod.quadrature.cell_ends
    sizes = np.diff(ends, prepend=0.0)
    points = ends[:, None] + sizes[:, None] * (x - 1)[None, :]
    powers = (x - 0.5)[None, :] ** np.arange(3)[:, None]
    kept = FROM_MOMENTS @ powers if rod.group.rotation_dim == 3 else powers[:1]
    return points, (w * kept)[:, None, :] * sizes[None, :, None]


def _rest_moments(rod: Rod, dtype) -> Float[Array, "order rot cells"]:
    rest, rot = _rest_strain(rod, dtype), rod.group.rotation_dim
    points, powers = _cells(rod)
    if rest.ndim == 1:
        return jnp.asarray(powers.sum(axis=2), dtype)[:, None, :] * rest[None, :rot, None]
    rows = jnp.asarray(interpolation_rows(rod.quadrature, points.reshape(-1)), dtype)
    values = (rest[:rot] @ rows.T).reshape(rot, *points.shape)
    return jnp.einsum("okp,rkp->ork", jnp.asarray(powers, dtype), values)


def _moments(rod: Rod, dtype) -> Float[Array, "order rot cells dof"]:
    """Moments of the curvature modes over the cells, unit length."""
    points, powers = _cells(rod)
    powers = jnp.asarray(powers, dtype)
    values = jnp.asarray(rod.basis(points.reshape(-1)), dtype)
    values = values.reshape(-1, *points.shape, rod.basis.num_dof)
    moments = jnp.einsum("okp,akpn->aokn", powers, values)
    active = dict(zip(rod.basis.active, moments, strict=True))
    zero = jnp.zeros(moments.shape[1:], dtype)
    names = strain_names(rod.group)[: rod.group.rotation_dim]
    return jnp.stack([active.get(name, zero) for name in names], axis=1)


def local_axis(name: str) -> int:
    """Local axis (0, 1, 2) of a strain component."""
    return STRAINS.index(name) % 3


def is_curvature(name: str) -> bool:
    return name.startswith("kappa")
