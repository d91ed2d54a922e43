"""The strains of a material curve of a solid, as a rod in its place would have them.

Twists from section to section by the logarithm of the relative motion, safe at any angle.
"""

import abc
import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._display import displayed, number
from sorojax._jax.trace_state import evaluated_now
from sorojax._types import Numbers, real
from sorojax.fem.equilibrium.solve import Path
from sorojax.math.two_programs import two_programs
from sorojax.mesh.measure import Locations, cells_at, locate
from sorojax.mesh.mesh import Mesh
from sorojax.rod.model.basis import STRAINS

# Material curves of a solid: where a rod's axis lies in the reference configuration.


_DENSE = 4001  # points by which arc length is counted


class AbstractCurve(eqx.Module):
    """A curve in the reference configuration, parametrised by s in [0, 1] at any speed."""

    @abc.abstractmethod
    def __call__(self, s: Float[Array, " points"]) -> Float[Array, "points dim"]:
        """Points [m]."""

    def spaced(self, s: Float[Array, " samples"]) -> "Spaced":
        """The points at shares `s` of the arc length."""

        def with_slope(s):
            return jax.jvp(self, (s,), (jnp.ones_like(s),))

        dense = jnp.linspace(0.0, 1.0, _DENSE)
        speed = _lengths(with_slope(dense)[1])
        way = jnp.cumsum((speed[1:] + speed[:-1]) / (2 * (_DENSE - 1)))
        way = jnp.concatenate([jnp.zeros(1), way])
        position, slope = with_slope(jnp.interp(s * way[-1], way, dense))
        tangent = slope / _lengths(slope)[:, None]
        return Spaced(position, tangent, way[-1], speed.min() / speed.max())


class Spaced(NamedTuple):
    """Points of a curve [m] with their unit tangents, its length [m], and the least speed of
    its parametrisation over the largest."""

    position: Float[Array, "samples dim"]
    tangent: Float[Array, "samples dim"]
    length: Float[Array, ""]
    evenness: Float[Array, ""]


class Line(AbstractCurve):
    """The straight line from `start` to `end` [m], in the plane or in space."""

    start: Float[Array, " dim"] = eqx.field(converter=real)
    end: Float[Array, " dim"] = eqx.field(converter=real)

    def __check_init__(self):
        dim = 3 if jnp.shape(self.start) == (3,) else 2
        do = "Give (x, y) in metres, or (x, y, z) in space."
        _check.shape("Line", "start", self.start, (dim,), do)
        _check.shape("Line", "end", self.end, (dim,), do)
        known = _check.is_concrete(self.start) and _check.is_concrete(self.end)
        if known and np.array_equal(self.start, self.end):
            raise ValueError(
                f"Line: `start` and `end` are both {np.asarray(self.start)} m. Give two points."
            )

    def __call__(self, s):
        return self.start[None] + s[:, None] * (self.end - self.start)[None]

    def spaced(self, s):
        way = self.end - self.start
        length = jnp.sqrt(jnp.sum(way**2))
        tangent = jnp.broadcast_to(way / length, (s.shape[0], way.shape[0]))
        return Spaced(self(s), tangent, length, jnp.ones_like(length))


class Curve(AbstractCurve):
    """Any smooth curve, by a `function` from s in [0, 1] to points (n, dim) [m]."""

    function: Callable = eqx.field(static=True)

    def __call__(self, s):
        return jnp.asarray(self.function(s))


class Reference(NamedTuple):
    """Equally spaced samples of a curve with a frame that does not turn about it.

    Attributes:
        s: Arc length over length.
        length: [m].
        position: [m].
        frame: Columns are the axes of the section; the first is the tangent.
    """

    s: Float[Array, " samples"]
    length: Float[Array, ""]
    position: Float[Array, "samples dim"]
    frame: Float[Array, "samples dim dim"]


def reference(curve: AbstractCurve, samples: int, up=None) -> Reference:
    """Samples of `curve` and its frames, differentiable in the numbers of the curve.

    Args:
        curve: The curve.
        samples: How many, ends included.
        up: In space, a direction near which local z starts; by default the axis of space
            that is most across the curve, the last one first.

    Raises:
        ValueError: If there are fewer than 3 samples, or the curve stands still somewhere.

    Reference:
        Wang, Juettler, Zheng, Liu, Computation of rotation minimizing frames, ACM
        Transactions on Graphics 27, 2008, for the double reflection.
    """
    if samples < 3:
        raise ValueError(f"backbone: got {samples} samples, need 3 or more. 81 are usual.")
    known, slowest, across = _compiled_reference(curve, samples, _real_or_none(up))
    if _check.is_concrete(slowest) and not slowest > 1e-9:
        raise ValueError(
            "backbone: the curve stands still at a point, need a smooth parametrisation."
        )
    if _check.is_concrete(across) and not across > 1e-6:
        raise ValueError(f"backbone: `up` is {up}, need a direction across the curve.")
    return known


def _reference(curve: AbstractCurve, samples: int, up):
    """The samples, the least speed over the largest, and how much of `up` is across."""

    s, size = jnp.linspace(0.0, 1.0, samples), jnp.ones(())
    position, tangent, length, evenness = curve.spaced(s)
    if position.shape[1] == 2:
        normal = jnp.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        frame = jnp.stack([tangent, normal], axis=2)
    else:
        if up is None:
            up = jnp.where(jnp.abs(tangent[0, 2]) < 0.9, jnp.eye(3)[2], jnp.eye(3)[1])
        across = up - jnp.dot(up, tangent[0]) * tangent[0]
        size = _lengths(across[None])[0]
        frame = _without_twist(position, tangent, across / size)
    return Reference(s, length, position, frame), evenness, size


_compiled_reference = two_programs(_reference, optimised=False)


def _lengths(vectors: Float[Array, "n dim"]) -> Float[Array, " n"]:
    return jnp.sqrt(jnp.sum(vectors**2, axis=1))


def _without_twist(position, tangent, z) -> Float[Array, "samples 3 3"]:
    """Frames about the tangents, the first with the axis `z`, by two reflections a step."""

    def advance(z, step):
        chord, here, there = step
        z, bent = _mirror(z, chord), _mirror(here, chord)
        z = _mirror(z, there - bent)
        return z, z

    steps = jnp.diff(position, axis=0), tangent[:-1], tangent[1:]
    z = jnp.concatenate([z[None], jax.lax.scan(advance, z, steps)[1]])
    return jnp.stack([tangent, jnp.cross(z, tangent), z], axis=2)


def _mirror(vector: Float[Array, "3"], normal: Float[Array, "3"]) -> Float[Array, "3"]:
    square = normal @ normal
    small = square < 1e-28
    safe = jnp.where(small, jnp.ones_like(square), square)
    return jnp.where(small, vector, vector - 2 * (normal @ vector) / safe * normal)


# Strain of a row of section poses: twists from pose to pose, safe at any turn.


_ITERATIONS = 5


def pose_strain(
    rotation: Float[Array, "samples 3 3"],
    position: Float[Array, "samples 3"],
    step: Float[Array, ""],
) -> Float[Array, "samples 6"]:
    """Curvatures and stretch and shears of equally spaced sections, order 2 in `step` [m].

    A constant strain is found exactly at any step, as long as the sections turn by less
    than pi between neighbours but one.
    """
    inner = twist(rotation[:-2], position[:-2], rotation[2:], position[2:]) / (2 * step)
    ends = (slice(0, 2), slice(1, 3)), (slice(-2, None), slice(-3, -1))
    first, last = (
        3 / 2 * _between(rotation[near], position[near], step)
        - 1 / 2 * _between(rotation[far], position[far], step)
        for near, far in ends
    )
    return jnp.concatenate([first, inner, last])


def _between(rotation, position, step) -> Float[Array, "1 6"]:
    return twist(rotation[:1], position[:1], rotation[1:], position[1:]) / step


def twist(
    turn_a: Float[Array, "n 3 3"],
    place_a: Float[Array, "n 3"],
    turn_b: Float[Array, "n 3 3"],
    place_b: Float[Array, "n 3"],
) -> Float[Array, "n 6"]:
    """Logarithm of the motion from pose a to pose b in the axes of a, angular first."""
    turn = jnp.einsum("nki,nkj->nij", turn_a, turn_b)
    path = jnp.einsum("nki,nk->ni", turn_a, place_b - place_a)
    vector, angle2 = _rotation_vector(turn)
    once = jnp.cross(vector, path)
    # 1/t^2 - (1 + cos t) / (2 t sin t), the inverse of the left Jacobian.
    small = angle2 < 1e-4
    safe = jnp.where(small, jnp.ones_like(angle2), angle2)
    angle = jnp.sqrt(safe)
    exact = (1 - angle / 2 / jnp.tan(angle / 2)) / safe
    beta = jnp.where(small, 1 / 12 + angle2 / 720, exact)
    linear = path - once / 2 + beta[:, None] * jnp.cross(vector, once)
    return jnp.concatenate([vector, linear], axis=1)


def _rotation_vector(turn: Float[Array, "n 3 3"]):
    """Rotation vectors [rad] and their squared lengths, smooth at zero."""
    axis = jnp.stack(
        [
            turn[:, 2, 1] - turn[:, 1, 2],
            turn[:, 0, 2] - turn[:, 2, 0],
            turn[:, 1, 0] - turn[:, 0, 1],
        ],
        axis=1,
    )
    axis = axis / 2
    cosine = (jnp.trace(turn, axis1=1, axis2=2) - 1) / 2
    square = jnp.sum(axis**2, axis=1)
    small = (square < 1e-8) & (cosine > 0)
    sine = jnp.sqrt(jnp.where(small, jnp.ones_like(square), square))
    ratio = jnp.where(small, 1 + square / 6, jnp.arctan2(sine, cosine) / sine)
    vector = ratio[:, None] * axis
    return vector, jnp.sum(vector**2, axis=1)


def nearest_rotation(columns: Float[Array, "n 3 3"]) -> Float[Array, "n 3 3"]:
    """Polar factor of matrices near a rotation, with derivatives where stretches agree."""
    for _ in range(_ITERATIONS):
        a, b, c = (columns[:, :, k] for k in range(3))
        cofactor = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=2)
        volume = jnp.sum(a * cofactor[:, :, 0], axis=1)
        columns = (columns + cofactor / volume[:, None, None]) / 2
    return columns


def section_axes(
    along_y: Float[Array, "n 3"], along_z: Float[Array, "n 3"]
) -> Float[Array, "n 3 3"]:
    """Section frames nearest to two fibres that a deformation has moved."""
    normal = jnp.cross(along_y, along_z)
    sides = (normal, along_y, along_z)
    return nearest_rotation(jnp.stack([_unit(side) for side in sides], axis=2))


def _unit(vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return vectors / _lengths(vectors)[:, None]


# The strains of a material curve of a solid: what a rod in its place would feel


PLANAR = ("kappa_z", "sigma_x", "sigma_y")


@displayed
class Backbone(eqx.Module):
    """Snapshots of a curve in the frame of its base: x along the curve at rest.

    `positions` [m] are those of the samples in every snapshot, `length` [m] is that of the
    curve at rest. `strain` holds kappa_z [1/m], sigma_x and sigma_y [-] at the samples `s` in
    [0, 1], in space all six strains; `rest` is that of the unloaded curve, None for a straight
    one. `cells` are those of the mesh that hold the samples, where there is a mesh.
    """

    s: Float[Array, " samples"]
    length: Float[Array, ""]
    positions: Float[Array, "steps samples dim"]
    strain: Float[Array, "steps samples strain"]
    rest: Float[Array, "samples strain"] | None = None
    cells: Int[Array, " points"] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns of `strain`."""
        return names_of(self.strain)

    def _text(self) -> str:
        steps, samples, dim = self.positions.shape
        return (
            f"Backbone: {steps} snapshots of {samples} samples in {dim} dimensions, length "
            f"{number(self.length, 'm')}\n  {', '.join(self.names)}"
        )

    @property
    def change(self) -> Float[Array, "steps samples strain"]:
        """Strain less that of the unloaded curve."""
        return self.strain - self.rest_or_straight[None]

    @property
    def rest_or_straight(self) -> Float[Array, "samples strain"]:
        return rest_or_straight(self.strain, self.rest)

    def rest_strain(self, s: Float[Array, " points"]) -> Float[Array, "points strain"]:
        """Strain at rest between the samples: give it to `rod` as its `rest_strain`."""
        columns = self.rest_or_straight.T
        return jnp.stack([jnp.interp(s, self.s, column) for column in columns], axis=1)


def names_of(strain: Float[Array, "*rows strain"]) -> tuple[str, ...]:
    return STRAINS if strain.shape[-1] == 6 else PLANAR


def rest_or_straight(
    strain: Float[Array, "steps samples strain"], rest: Float[Array, "samples strain"] | None
) -> Float[Array, "samples strain"]:
    """The strain at rest, without one that of a straight line."""
    if rest is not None:
        return rest
    straight = jnp.array([float(name == "sigma_x") for name in names_of(strain)])
    return jnp.broadcast_to(straight, strain.shape[1:])


class Probe(eqx.Module):
    """Samples of a curve in a mesh: takes a displacement field to positions and strain.

    Row 0 of `fibres` is the curve; then come pairs of points on either side along each
    axis of the section, unless the section follows the tangent.
    """

    locations: Locations
    fibres: Float[Array, "fibres samples dim"]
    base: Float[Array, "dim dim"]
    length: Float[Array, ""]
    s: Float[Array, " samples"]

    def __call__(self, u: Float[Array, "nodes dim"]) -> Float[Array, "samples dim"]:
        """Positions of the curve in the frame of its base [m]."""
        return self._moved(u)[0]

    def strain(self, u: Float[Array, "nodes dim"]) -> Float[Array, "samples strain"]:
        """Strain of the curve in a displacement field."""
        moved = self._moved(u)
        if len(moved) == 1:
            return line_strain(moved[0], self.length)
        y = moved[1] - moved[2]
        if moved.shape[2] == 3:
            axes, places = section_axes(y, moved[3] - moved[4]), moved[0]
        else:
            y, places = (jnp.pad(v, ((0, 0), (0, 1))) for v in (y, moved[0]))
            z = jnp.zeros_like(y).at[:, 2].set(1)
            axes = section_axes(y, z)
        found = pose_strain(axes, places, self.length / (len(self.s) - 1))
        return found if moved.shape[2] == 3 else found[:, jnp.array([2, 3, 4])]

    def _moved(self, u) -> Float[Array, "fibres samples dim"]:
        moved = self.fibres - self.fibres[:1, :1] + self.locations(u).reshape(self.fibres.shape)
        return moved @ self.base


def probe(
    mesh: Mesh,
    curve: AbstractCurve,
    samples: int = 81,
    *,
    arm: float | None = None,
    up: Numbers | None = None,
    cells: Int[Array, " points"] | None = None,
) -> Probe:
    """Equally spaced samples of `curve` in `mesh`; see `strain_along`.

    Raises:
        ValueError: If the curve, or the fibres beside it, leave the mesh.
    """
    if cells is None:
        cells = _chosen_cells(mesh, curve, samples, arm, up)
    return Probe(*_probe(mesh, curve, samples, arm, _real_or_none(up), cells), _even(samples))


def _chosen_cells(mesh: Mesh, curve: AbstractCurve, samples: int, arm, up):
    known = reference(curve, samples, up)
    fibres = _fibres(known, arm)
    try:
        return jnp.asarray(cells_at(mesh, fibres.reshape(-1, fibres.shape[-1])))
    except ValueError as error:
        if len(fibres) == 1:
            raise
        beside = known.length / _ARM if arm is None else arm
        raise ValueError(
            f"strain_along: {error} The fibres lie {beside:.3g} m beside it: lower `arm`."
        ) from None


def _real_or_none(up):
    return None if up is None else real(up)


def _even(samples: int) -> Float[Array, " samples"]:
    """Samples of any curve, which have no derivative."""
    with evaluated_now():
        return jnp.linspace(0.0, 1.0, samples)


@functools.partial(two_programs, optimised=False)
def _probe(mesh: Mesh, curve: AbstractCurve, samples: int, arm, up, cells):
    """All of a probe but its `s`."""
    known = _reference(curve, samples, up)[0]
    fibres = _fibres(known, arm)
    locations = locate(mesh, fibres.reshape(-1, fibres.shape[-1]), cells)
    return locations, fibres, known.frame[0], known.length


_ARM = 50  # length over the distance of the fibres, in space


def _fibres(known: Reference, arm) -> Float[Array, "fibres samples dim"]:
    rows, dim = [known.position], known.position.shape[1]
    if arm is None and dim == 3:
        arm = known.length / _ARM
    if arm is not None:
        for axis in range(1, dim):
            side = arm * known.frame[:, :, axis]
            rows += [known.position + side, known.position - side]
    return jnp.stack(rows)


def line_strain(
    positions: Float[Array, "samples 2"], length: Float[Array, ""]
) -> Float[Array, "samples 3"]:
    """Curvature, stretch and shear of a sampled line whose base points along x.

    Angles are those of the chords and curvatures their differences, so that integrating
    the curvature gives every chord angle back. The section follows the tangent: no shear.
    """
    step = length / (positions.shape[0] - 1)
    chord = jnp.diff(positions, axis=0)
    stretch = jnp.sqrt(jnp.sum(chord**2, axis=1)) / step
    turn = _turns(chord)
    base = jnp.arctan2(chord[0, 1], chord[0, 0])[None]
    # The base and the tip own half a step each; the tip adds no curvature.
    kappa = jnp.concatenate([2 * base, turn, jnp.zeros(1, positions.dtype)]) / step
    middle = (stretch[1:] + stretch[:-1]) / 2
    sigma = jnp.concatenate([stretch[:1], middle, stretch[-1:]])
    return jnp.stack([kappa, sigma, jnp.zeros_like(sigma)], axis=1)


def _turns(chord: Float[Array, "chords 2"]) -> Float[Array, " turns"]:
    """Angle from each chord to the next [rad]."""
    a, b = chord[:-1], chord[1:]
    return jnp.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], jnp.sum(a * b, axis=1))


def strain_along(
    path: Path,
    curve: AbstractCurve,
    *,
    samples: int = 81,
    arm: float | None = None,
    up: Numbers | None = None,
    near: Backbone | None = None,
) -> Backbone:
    """Strains of a material curve of a solid along a load path, as of a rod in its place.

    The twist from section to section is the logarithm of the relative motion, divided by the
    rest length between them. Differentiable in the displacements of the path, in the nodes of
    its mesh and in the numbers of the curve. Which cell holds a sample is chosen once and
    held: it has no derivative, the place inside the cell has.

    Args:
        path: Equilibria, from `fem.solve_path`.
        curve: A `Line` or any `Curve` in the reference configuration [m]; its start should be
            held fast.
        samples: Equally spaced samples along the curve; about one per cell.
        arm: Distance from the curve to the neighbouring material points whose motion gives
            the rotation of a section [m]. In space a fiftieth of the length by default; in the
            plane none by default: a section then follows the tangent and has no shear.
        up: In space, a direction near which local z of the first section points [-]; by default
            the axis of space that is most across the curve.
        near: A backbone of the same curve in a mesh with the same cells, whose samples stay
            in the cells where they are there. Needed under `jit` and `vmap`, where no cell
            can be chosen.

    Returns:
        Positions [m] and strains (curvatures [1/m], stretch and shears [-]) of every state.

    Raises:
        ValueError: If the curve, or the points beside it, leave the mesh, or there are fewer
            than 3 samples.

    Example:
        >>> grid = mesh.rectangle([0, 0], [60 * mm, 12 * mm], divisions=(6, 4),
        ...                       element=mesh.Quad4())
        >>> tube = mesh.submesh(grid, np.delete(np.arange(24), [6, 10, 14, 18]))  # a chamber
        >>> wall = mesh.facets_on(tube, sdf.Rectangle([10 * mm, 6 * mm], [50 * mm, 9 * mm]))
        >>> problem = fem.problem(
        ...     tube, material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1000),
        ...     kinematics=fem.PlaneStrain(20 * mm), loads=(fem.Pressure(wall, name="air"),),
        ...     supports=(fem.Fixed(tube.node_sets["left"]),))
        >>> path = fem.solve_path(problem, air=jnp.linspace(0, 3 * kPa, 4))
        >>> line = reduction.Line([0, 2 * mm], [60 * mm, 2 * mm])
        >>> backbone = reduction.strain_along(path, line, samples=13)
        >>> backbone.strain.shape, backbone.names
        ((4, 13, 3), ('kappa_z', 'sigma_x', 'sigma_y'))

    Reference:
        Caasenbrood, Pogromsky and Nijmeijer, Sorotoki, IEEE Access 12, 2024, algorithm 1.
    """
    return sampled(path, curve, samples, arm, up, near)[0]


def sampled(
    path: Path, curve: AbstractCurve, samples: int, arm, up, near: Backbone | None
) -> tuple[Backbone, Probe]:
    """The backbone of `strain_along`, and the probe that took it."""
    mesh, cells = path.problem.mesh, None if near is None else near.cells
    if cells is None:
        cells = _chosen_cells(mesh, curve, samples, arm, up)
    s = _even(samples)
    at, (positions, strain), rest = _sampled(
        mesh, curve, samples, arm, _real_or_none(up), cells, s, path.displacements
    )
    at = Probe(*at, s)
    return Backbone(s, at.length, positions, strain, rest, at.locations.cells), at


@functools.partial(two_programs, optimised=False)
def _sampled(mesh: Mesh, curve: AbstractCurve, samples: int, arm, up, cells, s, displacements):
    """All of a probe but its `s`, positions and strains of the states, and those at rest of
    a curve that is not straight."""
    parts = _probe(mesh, curve, samples, arm, up, cells)
    at = Probe(*parts, s)
    states = jax.vmap(at)(displacements), jax.vmap(at.strain)(displacements)
    if isinstance(curve, Line):
        return parts, states, None
    return parts, states, at.strain(jnp.zeros_like(displacements[0]))
