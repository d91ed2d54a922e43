"""A rod whose base is glued to a patch of nodes of a solid.

The base moves with the mean position of the patch and the rotation that brings its reference
shape closest to where its nodes are (least squares), so the patch stays free to deform. The
coordinates of the rod are unknowns beside the displacements, kept as those of a few more nodes,
and the rod is one potential of all of them: elastic energy, weight and a force at the tip. In
motion its sections are masses whose places depend on these unknowns (`fem.dynamics.masses`).
"""

import dataclasses
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._types import Numbers, integers, optional_real, real
from sorojax.fem.dynamics.masses import (
    Masses,
    MassMotion,
    begun_motion,
    inertia_energy,
    no_motion,
)
from sorojax.fem.kinematics import Axisymmetric
from sorojax.fem.loads.facets import CurvedPart
from sorojax.fem.loads.loads import AbstractLoad, mean_rotation
from sorojax.mesh.mesh import Mesh
from sorojax.rod.dynamics.dynamics import potential_energy
from sorojax.rod.dynamics.fields import is_curvature
from sorojax.rod.dynamics.kinematics import tip_pose
from sorojax.rod.dynamics.moving import mass_position
from sorojax.rod.model.basis import columns
from sorojax.rod.model.model import motion, operators
from sorojax.rod.model.rod import Rod

if TYPE_CHECKING:
    from sorojax.fem.problem import Problem


class MountedRod(AbstractLoad):
    """A rod on a patch of a solid: `mounted_rod(mesh, rod, nodes, ...)`.

    `rod` is glued with its base to `nodes`. `pose` is that of its base in the reference
    configuration, a homogeneous matrix with the position in m, and `gravity` [m/s^2] gives the
    rod its weight, None for none. `value` [N] is a dead force at its tip, in the axes of the
    mesh; `simulate` takes its values in time by the name of the rod. `places` are the nodes
    whose displacements hold the coordinates of the rod, curvatures times the square of its
    length, others times the length [m]. `axes` span the plane of the patch, None on a plane
    mesh, and `motion` is what its masses remember in a step; `mounted_rod` and `simulate` set
    these.
    """

    directed: ClassVar[bool] = True

    nodes: Int[Array, " nodes"] = eqx.field(converter=integers)
    places: Int[Array, " places"] = eqx.field(converter=integers)
    rod: Rod
    pose: Float[Array, "h h"] = eqx.field(converter=real)
    axes: Float[Array, "dim 2"] | None
    value: Float[Array, " dim"] = eqx.field(converter=real)
    name: str = eqx.field(static=True, default="rod")
    gravity: Float[Array, " dim"] | None = eqx.field(converter=optional_real, default=None)
    motion: MassMotion | None = None

    def coordinates(self, problem: "Problem", u: Float[Array, "nodes dim"]) -> Array:
        """Coordinates of the rod at displacement `u` [m]."""
        return self._coordinates(u[self.places])

    def base(self, problem: "Problem", u: Float[Array, "nodes dim"]) -> Float[Array, "h h"]:
        """Pose of the base at displacement `u` [m]."""
        X = problem.mesh.points[self.nodes]
        return self._base(X, X + u[self.nodes])

    def curved_part(self, problem):
        points, count = problem.mesh.points, self.nodes.shape[0]

        def energy(x, X):
            base = self._base(X[:count], x[:count])
            energy = self.energy(base, x[count:] - X[count:])
            if self.motion is None:
                return energy
            return energy + inertia_energy(self.masses(problem), self.motion, x)

        groups = self._group(jnp)
        return CurvedPart(groups, energy, points[groups])

    def couples(self):
        return self._group(np)

    def energy(self, base: Float[Array, "h h"], moved: Float[Array, "places dim"]):
        """Energy of the rod [J] on a `base`, its coordinates at displacements `moved` [m]."""
        q, turn, place = self._coordinates(moved), base[:-1, :-1], base[:-1, -1]
        unused = moved.ravel()[q.shape[0] :]
        pull = None if self.gravity is None else turn.T @ self.gravity
        energy = potential_energy(self.rod, q, pull)
        if self.gravity is not None:
            energy = energy - jnp.sum(operators(self.rod).mass) * jnp.sum(self.gravity * place)
        tip = place + turn @ tip_pose(self.rod, q)[:-1, -1]
        held = 0.5 * self._unit() * jnp.sum(unused**2)
        return energy - jnp.sum(self.value * tip) + held

    def masses(self, problem):
        group, count = self._group(jnp)[0], self.nodes.shape[0]
        X = problem.mesh.points[group]
        constants = operators(self.rod)
        across = constants.rotary[-1:0:-1] if X.shape[1] == 3 else constants.rotary
        each = jnp.broadcast_to(constants.mass, (X.shape[1], *constants.mass.shape))

        def places(x):
            base = self._base(X[:count], x[:count])
            centres, axes, unused = self._sections(x[count:] - X[count:])
            turn, shift = base[:-1, :-1], base[:-1, -1]
            centres, axes = centres @ turn.T + shift[None], axes @ turn.T
            return jnp.concatenate([centres.T.ravel(), axes.ravel(), unused])

        unused = self.places.shape[0] * X.shape[1] - self.rod.basis.num_dof
        total = jnp.broadcast_to(jnp.sum(constants.mass), (unused,))
        turning = jnp.repeat(across, X.shape[1])
        weights = jnp.concatenate([each.ravel(), turning, total])
        return Masses(group, places, weights, self.places)

    def in_motion(self, problem):
        masses = self.masses(problem)
        return dataclasses.replace(self, motion=no_motion(masses, problem.mesh.points))

    def begun(self, problem, step):
        if step.scheme is None:
            return self.without_inertia()
        assert self.motion is not None
        motion = begun_motion(self.masses(problem), self.motion, problem, step)
        return dataclasses.replace(self, motion=motion)

    def without_inertia(self):
        return dataclasses.replace(self, motion=None)

    def stored(self, problem, u):
        return self.without_inertia().potential(problem, u)

    def _sections(self, moved: Float[Array, "places dim"]):
        """Centres of mass of the sections and their axes across, one after the other, in the
        axes of the base; and the entries that hold no coordinate."""
        q = self._coordinates(moved)
        moment = motion(self.rod, q)
        axes = jnp.moveaxis(moment.directors, 2, 0)[1:].reshape(-1, moved.shape[1])
        return mass_position(moment), axes, moved.ravel()[q.shape[0] :]

    def _unit(self) -> Float[Array, ""]:
        """A stiffness of the size of the rod's [N/m], for entries that hold no coordinate."""
        section, young = self.rod.section, self.rod.material.young_modulus
        return jnp.mean(young * section.second_moment_z) / self.rod.length**3

    def _coordinates(self, moved: Float[Array, "places dim"]) -> Float[Array, " coordinates"]:
        return moved.ravel()[: self.rod.basis.num_dof] / _scales(self.rod)

    def _base(self, X, x) -> Float[Array, "h h"]:
        turn = _rotation(X, x, self.axes)
        before, now = jnp.mean(X, axis=0), jnp.mean(x, axis=0)
        place = now + turn @ (self.pose[:-1, -1] - before)
        top = jnp.concatenate([turn @ self.pose[:-1, :-1], place[:, None]], axis=1)
        return jnp.concatenate([top, self.pose[-1:]], axis=0)

    def _group(self, xp):
        return xp.concatenate([xp.asarray(self.nodes), xp.asarray(self.places)])[None]

    def check(self, where, mesh, kinematics):
        if isinstance(kinematics, Axisymmetric):
            raise ValueError(
                f"fem.problem: {where} stands on a body of revolution, where it would be a "
                "surface. Use a solid mesh."
            )


def _scales(rod: Rod) -> Float[Array, " coordinates"]:
    """Displacement [m] over coordinate."""
    scales = jnp.ones(rod.basis.num_dof, rod.length.dtype) * rod.length
    for name in rod.basis.active:
        if is_curvature(name):
            scales = scales.at[columns(rod.basis, name)].multiply(rod.length)
    return scales


def _rotation(X, x, axes) -> Float[Array, "dim dim"]:
    """The rotation that brings points `X` closest to `x`, each about their centre; in space
    of their projections onto the plane of `axes`, where the patch lies.

    The square root of a symmetric 2 x 2 matrix is (M + s) / t with s^2 = det M and
    t^2 = tr M + 2 s: smooth also where eigenvalues meet, as they do in a square patch.
    """
    if axes is None:
        angle = mean_rotation(X, x)
        c, s = jnp.cos(angle), jnp.sin(angle)
        return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])
    a, b = (p - jnp.mean(p, axis=0, keepdims=True) for p in (X, x))
    plane = a @ axes
    image = b.T @ plane @ jnp.linalg.inv(plane.T @ plane)
    square = image.T @ image
    s = jnp.sqrt(square[0, 0] * square[1, 1] - square[0, 1] * square[1, 0])
    root = (square + s * jnp.eye(2, dtype=s.dtype)) / jnp.sqrt(jnp.trace(square) + 2 * s)
    turned = image @ jnp.linalg.inv(root)
    third = jnp.cross(turned[:, 0], turned[:, 1])
    before = jnp.stack([*axes.T, jnp.cross(axes[:, 0], axes[:, 1])])
    return jnp.stack([*turned.T, third], axis=1) @ before


def mounted_rod(
    mesh: Mesh,
    rod: Rod,
    nodes: Int[Array | np.ndarray, " nodes"],
    pose: Float[Array | np.ndarray, "h h"],
    *,
    value: Numbers | None = None,
    gravity: Numbers | None = None,
    name: str = "rod",
) -> tuple[Mesh, MountedRod]:
    """The mesh with room for the coordinates of `rod`, and the rod on a patch of the solid.

    In `fem.problem(mesh, ..., loads=(mounted,))` rod and solid are in equilibrium together, in
    large rotations of both; `solve`, `solve_path` and their derivatives are as elsewhere. They
    move together in `simulate`, in `eigenmodes` and as a `systems.FemBody`, whatever the one
    weighs beside the other; the rod has the inertia of its sections and no damping of its own.
    A rod with other forces, chambers or contact stands on a solid in a network: a part of an
    assembly on a free `rod.Link` without mass that is `carrying` the face.

    Args:
        mesh: The solid.
        rod: Planar on a plane mesh, spatial on a solid one; stiffness and forces in the plane
            are those of the whole depth.
        nodes: Of the patch that the base is glued to, for example a facet set's.
        pose: Of the base in the reference configuration, homogeneous, position [m]; the rod
            goes along its local x.
        value: Dead force at the tip [N], along the axes of the mesh.
        gravity: Acceleration that gives the rod its weight [m/s^2].
        name: Of the term, and of the set of the new nodes.

    Returns:
        The mesh and the load.

    Raises:
        ValueError: If rod and mesh are not of one space, or the patch has no direction.

    Example:
        >>> block = mesh.rectangle([0, 0], [20 * mm, 10 * mm], divisions=(4, 2), order=2)
        >>> whisker = rod.rod(SE2(), rod.chebyshev(kappa_z=2), rod.circle(1 * mm), length=0.05,
        ...                   young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> side = block.node_sets["right"]
        >>> base = jnp.array([[1, 0, 20 * mm], [0, 1, 5 * mm], [0, 0, 1]])
        >>> both, mounted = coupling.mounted_rod(block, whisker, side, base, value=[0, 1e-4])
        >>> both.num_nodes - block.num_nodes
        1
    """
    dim, count = mesh.element.dim, rod.basis.num_dof
    pose, ids = real(pose), np.unique(np.asarray(nodes, int))
    if rod.group.space_dim != dim or pose.shape != (dim + 1, dim + 1):
        raise ValueError(
            f"coupling.mounted_rod: got a rod in {rod.group.space_dim} dimensions and a pose "
            f"of shape {pose.shape} on a mesh in {dim}, need one space. Take SE2() in the "
            "plane, SE3() in space."
        )
    X = np.asarray(jax.lax.stop_gradient(mesh.points))[ids]
    away = X - X.mean(axis=0, keepdims=True)
    spread, axes = np.linalg.svd(away, full_matrices=True)[1:]
    if len(ids) < dim or spread[dim - 2] <= 1e-9 * spread[0] or not spread[0] > 0:
        raise ValueError(
            f"coupling.mounted_rod: the patch of {len(ids)} nodes has no direction, need "
            f"{'two' if dim == 2 else 'three, not in a row,'} or more. Select nodes of a face."
        )
    place, many = pose[:-1, -1], -(-count // dim)
    points = jnp.concatenate([mesh.points, jnp.broadcast_to(place, (many, dim))])
    places = mesh.num_nodes + np.arange(many)
    sets = mesh.node_sets | {name: integers(places)}
    wider = dataclasses.replace(mesh, points=points, node_sets=sets)
    frame = None if dim == 2 else jnp.asarray(axes[:2].T, mesh.points.dtype)
    force = np.zeros(dim) if value is None else value
    _check.finite("coupling.mounted_rod", "value", real(force), "Newtons.")
    return wider, MountedRod(ids, places, rod, pose, frame, force, name, gravity)


class MountWrench(NamedTuple):
    """What a mounted rod does to its patch, and how it stands.

    Attributes:
        force: On the solid [N].
        moment: On the solid about the base [N m]; in the plane counter-clockwise.
        coordinates: Of the rod.
        base: Pose of the base.
        tip: Pose of the tip.
    """

    force: Float[Array, " dim"]
    moment: Float[Array, " turns"]
    coordinates: Float[Array, " coordinates"]
    base: Float[Array, "h h"]
    tip: Float[Array, "h h"]


def mount_wrench(
    problem: "Problem", u: Float[Array, "nodes dim"], name: str = "rod"
) -> MountWrench:
    """Force and moment of the mounted rod called `name` on the solid at displacement `u` [m],
    and how the rod stands. Differentiable.

    Args:
        problem: With the mounted rod.
        u: Displacement [m].
        name: Of the rod.

    Returns:
        Force [N], moment [N m], and how the rod stands.

    Raises:
        ValueError: If there is no such rod.
    """
    rods = [x for x in problem.loads if isinstance(x, MountedRod)]
    found = [x for x in rods if x.name == name]
    if not found:
        names = [x.name for x in rods]
        raise ValueError(f"coupling.mount_wrench: got name {name!r}, need one of {names}.")
    return _wrench(found[0], problem, u)


@jax.jit
def _wrench(load: MountedRod, problem: "Problem", u) -> MountWrench:
    base, moved = load.base(problem, u), u[load.places]
    dim, q = moved.shape[1], load.coordinates(problem, u)
    turns = 1 if dim == 2 else 3

    def energy(shift, turn):
        spun = jnp.concatenate(
            [base[:-1, :-1] + _cross(turn, base[:-1, :-1]), base[:-1, -1:]], 1
        )
        spun = spun.at[:, -1].add(shift)
        return load.energy(jnp.concatenate([spun, base[-1:]]), moved)

    zeros = jnp.zeros(dim, u.dtype), jnp.zeros(turns, u.dtype)
    force, moment = jax.grad(energy, argnums=(0, 1))(*zeros)
    return MountWrench(-force, -moment, q, base, base @ tip_pose(load.rod, q))


def _cross(turn, columns):
    """Small rotation `turn` times each column."""
    if turn.shape[0] == 1:
        return turn[0] * jnp.stack([-columns[1], columns[0]])
    return jnp.cross(turn[:, None], columns, axis=0)
