"""A rod's elastic law, pressure map and section, identified from a FEM load path.

At every equilibrium of the path the solid answers a generalised force on the strain
coordinates q with its condensed stiffness, one back-substitution per coordinate on the
tangent. A co-energy

    Psi*(q, p) = g(p).q + p q'Cq / 2 + h(p) - q'Kq / 2

is fitted to stiffness, equilibrium and enclosed volume together: K - p C is the condensed
stiffness, dPsi*/dq = 0 the equilibrium, and dPsi*/dp the volume. One potential gives force
and volume, so no energy is lost between gas and rod.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._edit import without_derivatives
from sorojax._jax.trace_state import evaluated_now, is_traced
from sorojax._progress import report
from sorojax._types import Numbers, real
from sorojax.fem.assembly.geometry import quadrature_points
from sorojax.fem.checks import no_peaks
from sorojax.fem.dynamics.damping import lumped_mass
from sorojax.fem.equilibrium.linear import prepare
from sorojax.fem.equilibrium.response import tangent_solve
from sorojax.fem.equilibrium.solve import Path
from sorojax.fem.kinematics import PlaneStrain, Solid
from sorojax.fem.loads.facets import cavity_volume
from sorojax.fem.loads.loads import Pressure
from sorojax.fem.problem import Problem, body
from sorojax.math.lie import SE2, SE3
from sorojax.math.linalg.dense import least_squares
from sorojax.math.two_programs import two_programs
from sorojax.mesh.mesh import Mesh
from sorojax.reduction.backbone import (
    AbstractCurve,
    Backbone,
    Line,
    Probe,
    Reference,
    names_of,
    probe,
    reference,
    rest_or_straight,
)
from sorojax.reduction.damping import ConstantDamping
from sorojax.reduction.pod import project
from sorojax.rod import (
    AbstractForce,
    AbstractPressureMap,
    LinearElastic,
    Section,
    StrainBasis,
    points,
)

# The uniform section that carries the mass of a body along a curve.


_SAMPLES = 201


def mean_section(
    problem: Problem, curve: AbstractCurve, *, up: Numbers | None = None
) -> Section:
    """The section of a uniform rod along `curve` with the mass of the body, its mean offset
    from the curve and its rotary inertia about it. Of a solid the torsion constant is the
    polar moment, an upper bound. Differentiable in the nodes and in the curve; which section a
    point belongs to has no derivative.

    Args:
        problem: The body, in plane strain or solid.
        curve: Axis of the rod [m].
        up: In space, a direction near which local z of the section points [-].

    Returns:
        The constants of the section.

    Raises:
        ValueError: If the body is neither plane strain nor solid.
    """
    if not isinstance(problem.kinematics, PlaneStrain | Solid):
        raise ValueError(
            f"mean_section: got {type(problem.kinematics).__name__}, need PlaneStrain or "
            "Solid. Give the rod a section of your own."
        )
    along = reference(curve, _SAMPLES, up)
    return _mean_section(problem.mesh, problem.kinematics, along)


@functools.partial(two_programs, optimised=False)
def _mean_section(mesh: Mesh, kinematics: PlaneStrain | Solid, known: Reference) -> Section:
    inside = quadrature_points(mesh, kinematics)
    points = jnp.moveaxis(inside.position, 0, -1).reshape(-1, kinematics.dim)
    volume, offsets, moments = _moments(points, inside.volumes.reshape(-1), known)
    area, about_z = volume / known.length, moments[0] / known.length
    if isinstance(kinematics, Solid):
        about_y = moments[1] / known.length
    else:
        about_y = area * kinematics.thickness**2 / 12
    return Section(
        area,
        about_y,
        about_z,
        about_y + about_z,
        5 / 6,
        mass_offset_y=offsets[0],
        mass_offset_z=offsets[1] if len(offsets) > 1 else None,
    )


def _moments(
    points: Float[Array, "points dim"], volumes: Float[Array, " points"], curve: Reference
) -> tuple[Array, list[Array], list[Array]]:
    """Volume, its mean place along each axis of the section, and its second moments, each
    point in the section of the sample of the curve that is nearest to it."""
    places = jax.lax.stop_gradient(curve.position)

    def nearest(point):
        return jnp.argmin(jnp.sum((places - point[None]) ** 2, axis=1))

    near = jax.lax.map(nearest, jax.lax.stop_gradient(points), batch_size=4096)
    local = jnp.einsum("pi,pij->pj", points - curve.position[near], curve.frame[near])
    total, across = jnp.sum(volumes), [local[:, k] for k in range(1, local.shape[1])]
    means = [jnp.sum(volumes * x) / total for x in across]
    return total, means, [jnp.sum(volumes * x**2) for x in across]


# The weight of a solid on the rod that stands in for it


_STATIONS = 24


class OffsetWeight(AbstractForce):
    """Weight of a planar rod whose mass lies beside its line, evenly along it.

    Attributes:
        mass: In all [kg].
        arm: From the line to the mass, along the second director [m].
        acceleration: [m/s^2].
    """

    mass: Float[Array, ""] = eqx.field(converter=real)
    arm: Float[Array, ""] = eqx.field(converter=real)
    acceleration: Float[Array, "2"] = eqx.field(converter=real)

    def __call__(self, t, motion):
        at = points(motion, (np.arange(_STATIONS) + 0.5) / _STATIONS)
        away = self.arm * at.directors[:, :, 1]
        load = jnp.broadcast_to(self.mass / _STATIONS * self.acceleration, away.shape)
        turn = away[:, 0] * load[:, 1] - away[:, 1] * load[:, 0]
        return at.generalised(load, turn[:, None])


def offset_weight(problem: Problem, line: Line, acceleration: Numbers) -> OffsetWeight:
    """The weight of a planar solid about a straight line in it.

    Args:
        problem: The solid, with a density.
        line: Of the rod.
        acceleration: Of gravity [m/s^2].

    Returns:
        One of the forces on the rod.
    """
    shares = lumped_mass(problem).reshape(-1, 2)[:, 0]
    along = line.end - line.start
    along = along / jnp.sqrt(jnp.sum(along**2))
    middle = shares @ problem.mesh.points / shares.sum() - line.start
    return OffsetWeight(shares.sum(), along[0] * middle[1] - along[1] * middle[0], acceleration)


# The laws of the rod, identified from a FEM load path.


class PressureMap(AbstractPressureMap):
    """Work that gas at a gauge pressure can do on the coordinates and on the chamber walls.

    `force` and `walls` are coefficients of polynomials in p / `scale`: g(p), without a
    constant, and h(p). Good for pressures from 0 to about `scale`.

    Attributes:
        coupling: C, change of stiffness per pressure.
        force: Coefficients of g, powers 1, 2, ...
        walls: Coefficients of h [J], powers 1, 2, ...
        scale: Largest pressure of the path [Pa].
        ports: Shape of the pressure: (), one number.
    """

    coupling: Float[Array, "dof dof"] = eqx.field(converter=real)
    force: Float[Array, "powers dof"] = eqx.field(converter=real)
    walls: Float[Array, " powers"] = eqx.field(converter=real)
    scale: Float[Array, ""] = eqx.field(converter=real)
    ports: tuple[int, ...] = eqx.field(static=True, default=())

    def coenergy(self, q: Float[Array, " dof"], pressure: Float[Array, ""]) -> Float[Array, ""]:
        x = pressure / self.scale
        push = _powers(x, self.force.shape[0]) @ self.force
        return (
            push @ q
            + pressure * (q @ self.coupling @ q) / 2
            + (_powers(x, self.walls.shape[0]) @ self.walls)
        )


class Fit(eqx.Module):
    """The laws of a rod that stands in for the solid, and how well they were found.

    Attributes:
        section: Mean section: mass and rotary inertia about the line.
        length: Length of the line [m].
        elastic: Linear elastic law K.
        pressure: Pressure map.
        stiffness_error: Largest misfit of the condensed stiffness, relative.
        volume_error: Largest misfit of the enclosed volume, relative to its change.
        position_error: Largest distance between the line of the rod at rest under a pressure of
            the path and that of the solid, relative to the largest way of a point of the
            latter. It is large where the modes leave out a strain that matters.
    """

    section: Section
    length: Float[Array, ""]
    elastic: LinearElastic
    pressure: PressureMap
    stiffness_error: Float[Array, ""]
    volume_error: Float[Array, ""]
    position_error: Float[Array, ""]

    def damping(self, time) -> ConstantDamping:
        """Kelvin-Voigt damping with a retardation `time` [s] of the identified stiffness."""
        return ConstantDamping(real(time) * self.elastic.stiffness)


def identify(
    path: Path,
    basis: StrainBasis,
    backbone: Backbone,
    curve: AbstractCurve,
    *,
    degree: int = 5,
    arm: float | None = None,
    up: Numbers | None = None,
) -> Fit:
    """Identify elastic law, pressure map and section of a rod along `curve` from a load path.

    At every state the solid answers generalised forces on the strain coordinates q with its
    condensed stiffness (H K^-1 H')^-1, K the tangent and H = dq/du. A co-energy
    g(p).q + p q'Cq / 2 + h(p) - q'Kq / 2 is fitted to stiffness, equilibrium and enclosed
    volume.

    Args:
        path: Equilibria for values of one `Pressure` load [Pa].
        basis: Modes, e.g. from `pod_basis`.
        backbone: Snapshots of the same path along `curve`.
        curve: The material curve [m], in the plane or in space.
        degree: Highest power of the pressure in the map.
        arm: Distance of the points beside the curve [m], as given to `strain_along`.
        up: Direction of local z of the first section [-], as given to `strain_along`.

    Returns:
        Section, length, elastic law and pressure map of the rod, and what they miss. A line
        that is more than a tenth off gives a warning.

    Raises:
        ValueError: If the path is not driven by a pressure, or has fewer than `degree` + 2
            states.

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
        >>> basis = reduction.pod_basis(backbone, modes={"kappa_z": 1})
        >>> fit = reduction.identify(path, basis, backbone, line, degree=2)
        >>> print(f"{float(fit.length) / mm:.1f} mm, {fit.elastic.stiffness.shape}")
        60.0 mm, (1, 1)
    """
    at = _probe(path, curve, backbone, arm, up)
    fit = identified(path, basis, backbone, at, curve, degree, up)
    off = fit.position_error
    if _check.is_concrete(off) and float(off) > _FAR:
        left = [name for name in backbone.names if name not in basis.active]
        _check.warn(
            f"identify: the line of the rod is {float(off):.0%} of its way off that of the "
            f"solid. Give the basis more modes{f', or {left}' if left else ''}: `pod_basis("
            "backbone, modes=...)`."
        )
    return fit


_FAR = 0.1  # of the largest way: the rod does not stand for the solid


def identified(
    path: Path, basis: StrainBasis, backbone: Backbone, at: Probe, curve, degree: int, up
) -> Fit:
    """`identify` with a probe that is known."""
    problem, load = path.problem, _pressure(path)
    if len(path) < degree + 2:
        raise ValueError(
            f"identify: the path holds {len(path)} states, need {degree + 2} for `degree` "
            f"{degree}. Solve at more pressures or lower `degree`."
        )
    condensed = _condensed_stiffness(path, at, basis)
    volumes = _volumes(body(problem), path.displacements, load.facets)
    laws, errors = _fitted(
        path.values,
        backbone.s,
        backbone.strain,
        backbone.rest,
        basis,
        volumes,
        condensed,
        backbone.positions,
        backbone.length,
        degree,
    )
    return Fit(mean_section(problem, curve, up=up), backbone.length, *laws, *errors)


def _probe(path: Path, curve, backbone: Backbone, arm, up) -> Probe:
    """The samples of `backbone`; its cells are chosen again where other fibres are asked
    for."""
    cells, beside = backbone.cells, arm is not None or len(backbone.names) == 6
    dim = path.problem.mesh.element.dim
    fibres = 1 + 2 * (dim - 1) * beside
    if cells is not None and len(cells) != fibres * len(backbone.s):
        cells = None
    return probe(path.problem.mesh, curve, len(backbone.s), arm=arm, up=up, cells=cells)


@two_programs
def _volumes(problem: Problem, displacements, facets) -> Float[Array, " steps"]:
    """Of the cavity at each state [m^3]."""
    return jax.vmap(lambda u: cavity_volume(problem, u, facets))(displacements)


def _pressure(path: Path) -> Pressure:
    terms = *path.problem.loads, *path.problem.supports
    load = next(term for term in terms if term.name == path.name)
    if not isinstance(load, Pressure):
        raise ValueError(
            f"identify: the path is driven by the {type(load).__name__} '{path.name}', need a "
            "Pressure. Solve the path over the pressure of a cavity."
        )
    return load


def condensed_stiffness(
    path: Path,
    basis: StrainBasis,
    curve: AbstractCurve,
    *,
    samples: int = 81,
    arm: float | None = None,
    up: Numbers | None = None,
    near: Backbone | None = None,
) -> Float[Array, "steps dof dof"]:
    """Stiffness of the solid against forces on the coordinates, at each state of any path.

    That at rest is the elastic law of a rod: `LinearElastic(condensed_stiffness(...)[0])`.
    The arguments are those of `strain_along`. Differentiable in the numbers of the problem, the
    displacements, the curve and the modes, once: see `tangent_solve`.

    Args:
        path: Equilibria, from `fem.solve_path`.
        basis: Modes, e.g. from `pod_basis`.
        curve: A `Line` or any `Curve` in the reference configuration [m].
        samples: Equally spaced samples along the curve.
        arm: As in `strain_along` [m].
        up: As in `strain_along`.
        near: As in `strain_along`.

    Returns:
        A symmetric matrix per state.
    """
    cells = None if near is None else near.cells
    at = probe(path.problem.mesh, curve, samples, arm=arm, up=up, cells=cells)
    return _condensed_stiffness(path, at, basis)


def _condensed_stiffness(
    path: Path, at: Probe, basis: StrainBasis
) -> Float[Array, "steps dof dof"]:
    """Stiffness against generalised forces on q at each equilibrium: (H K^-1 H')^-1."""
    if path.strains is not None:
        raise ValueError(
            "identify: got states of a viscoelastic body over `times`, need equilibria "
            "that have relaxed. Leave `times` out of fem.solve_path."
        )
    no_peaks("identify", path.problem.material)
    ways, states = _slopes(at, basis, path.displacements)
    answers, fixed = [], without_derivatives(path.problem)
    with evaluated_now(fixed):
        prepared = None if is_traced(fixed) else prepare(fixed)
    for value, u, forces in zip(path.loading, states, ways, strict=True):
        answers.append(tangent_solve(path.problem_under(value), u, forces, prepared))
        report("identify", len(answers), len(path))
    return _inverse(ways, answers)


@two_programs
def _slopes(at: Probe, basis: StrainBasis, displacements) -> tuple[list[Array], list[Array]]:
    """H = dq/du of the coordinates (dof, dofs), and the displacements, of each state."""

    def one(u):
        slopes = jax.jacrev(lambda u: project(at.strain(u), at.s, basis))(u)
        return slopes.reshape(basis.num_dof, -1)

    return list(jax.vmap(one)(displacements)), list(displacements)


@functools.partial(two_programs, optimised=False)
def _inverse(ways, answers) -> Float[Array, "steps dof dof"]:
    compliance = jnp.einsum("kin,kjn->kij", jnp.stack(ways), jnp.stack(answers))
    return jnp.linalg.inv((compliance + jnp.moveaxis(compliance, 1, 2)) / 2)


@functools.partial(two_programs, optimised=False)
def _fitted(
    p, s, strain, rest, basis: StrainBasis, volumes, condensed, positions, length, degree: int
):
    """Elastic law and pressure map, and the misfit of stiffness, volume and positions.

    K and C of the least-squares fit K - p C, then g from the equilibria, then h from the
    volumes that remain.
    """
    change = strain - rest_or_straight(strain, rest)[None]
    q = jax.vmap(lambda change: project(change, s, basis))(change)
    scale = jnp.max(jnp.abs(p))
    x = p / scale
    linear = jnp.stack([jnp.ones_like(x), -x], axis=1)
    K, C = least_squares(linear, condensed.reshape(len(p), -1)).reshape(2, *condensed.shape[1:])
    C = C / scale
    push = q @ K - p[:, None] * (q @ C)
    powers = jnp.stack([x**k for k in range(1, degree + 1)], axis=1)
    force = least_squares(powers, push)
    slopes = jnp.stack([k * x ** (k - 1) for k in range(1, degree + 1)], axis=1)
    bent = jnp.einsum("ki,ki->k", slopes @ force / scale, q)
    bent = bent + jnp.einsum("ki,ij,kj->k", q, C, q) / 2
    pressure = PressureMap(C, force, least_squares(slopes, (volumes - bent) * scale), scale)
    misfit = jnp.max(jnp.abs(K[None] - p[:, None, None] * C[None] - condensed))
    found = jax.vmap(jax.grad(pressure.coenergy, argnums=1))(q, p)
    pushes = powers @ force
    still = jax.vmap(lambda p, push: jnp.linalg.solve(K - p * C, push))(p, pushes)
    errors = (
        misfit / jnp.max(jnp.abs(condensed)),
        jnp.max(jnp.abs(found - volumes)) / jnp.ptp(volumes),
        _off(still, basis, s, rest_or_straight(strain, rest), positions, length),
    )
    return (LinearElastic(K), pressure), errors


def _off(q, basis: StrainBasis, s, rest, positions, length) -> Float[Array, ""]:
    """Largest distance of the lines of a rod with coordinates q from `positions`, over the
    largest way of these from rest."""
    dim, names, shapes = positions.shape[2], names_of(rest), jnp.asarray(basis(s))
    group = SE2() if dim == 2 else SE3()

    def line(q):
        strain = rest
        for row, name in zip(shapes, basis.active, strict=True):
            strain = strain.at[:, names.index(name)].add(row @ q)
        steps = (strain[1:] + strain[:-1]) / 2 * (jnp.diff(s) * length)[:, None]

        def onward(pose, step):
            pose = pose @ group.exp(step)
            return pose, pose[:dim, dim]

        first = jnp.eye(dim + 1, dtype=rest.dtype)
        return jax.lax.scan(onward, first, steps)[1]

    way = positions[:, 1:] - line(jnp.zeros_like(q[0]))[None]
    gap = positions[:, 1:] - jax.vmap(line)(q)
    farthest, largest = (jnp.max(jnp.sum(x**2, axis=-1)) for x in (gap, way))
    return jax.lax.stop_gradient(jnp.sqrt(farthest / largest))


def _powers(x: Float[Array, ""], count: int) -> Float[Array, " powers"]:
    return jnp.stack([x**k for k in range(1, count + 1)])
