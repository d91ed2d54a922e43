r"""A rod's elastic law, pressure map and section, identified from a FEM load path, and its
damping from a motion.

At every equilibrium of the path the solid answers a generalised force on the strain
coordinates q with its condensed stiffness, one back-substitution per coordinate on the
tangent. A co-energy

    Psi*(q, p) = g(p).q + p q'Cq / 2 + h(p) - q'Kq / 2

is fitted to stiffness, equilibrium and enclosed volume together: K - p C is the condensed
stiffness, dPsi*/dq = 0 the equilibrium, and dPsi*/dp the volume. One potential gives force
and volume, so no energy is lost between gas and rod.

For the damping the equations of motion are tested with windows in time: over a window w that
begins and ends with weight zero,

    D \int w v dt = \int (w f + w' M v) dt,

where f holds all forces but damping. No acceleration of the samples is needed. D is the
symmetric positive semidefinite matrix that fits all windows best, one block for each strain.

Reference:
    Messenger and Bortz, Weak SINDy for partial differential equations, J. Comput. Phys. 443,
    2021, for tests with windows.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._progress import report
from sorojax._types import Numbers, real
from sorojax.fem.assembly.geometry import quadrature_points
from sorojax.fem.dynamics.damping import lumped_mass
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.fem.equilibrium.solve import Path
from sorojax.fem.kinematics import PlaneStrain, Solid
from sorojax.fem.loads.loads import Pressure
from sorojax.fem.problem import Problem
from sorojax.fem.stress import enclosed_volume
from sorojax.math.host import KDTree
from sorojax.math.linalg import sparse
from sorojax.reduction.backbone import AbstractCurve, Backbone, Line, Probe, probe, reference
from sorojax.reduction.pod import coordinates, project
from sorojax.rod import (
    AbstractDamping,
    AbstractForce,
    AbstractPressureMap,
    LinearElastic,
    Rod,
    Section,
    StrainBasis,
    inertia,
    motion,
    operators,
    points,
    stiffness_matrix,
    total_force,
)
from sorojax.rod.dynamics.dynamics import Forces
from sorojax.rod.model.basis import columns

# The uniform section that carries the mass of a body along a curve.


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
        area,
        about_y,
        about_z,
        about_y + about_z,
        5 / 6,
        mass_offset_y=offsets[0],
        mass_offset_z=offsets[1] if len(offsets) > 1 else None,
    )


@jax.jit
def _moments(
    points: Array, volumes: Array, places: Array, frames: Array
) -> tuple[Array, list[Array], list[Array]]:
    """Volume, its mean place along each axis of the section, and its second moments."""
    local = jnp.einsum("pi,pij->pj", points - places, frames)
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
    """
    shares = np.asarray(lumped_mass(problem)).reshape(-1, 2)[:, 0]
    start, end = np.asarray(line.start), np.asarray(line.end)
    along = (end - start) / np.linalg.norm(end - start)
    middle = shares @ np.asarray(problem.mesh.points) / shares.sum() - start
    return OffsetWeight(shares.sum(), along[0] * middle[1] - along[1] * middle[0], acceleration)


# A rod's elastic law, pressure map and section, identified from a FEM load path.
#
# At every equilibrium of the path the solid answers a generalised force on the strain
# coordinates q with its condensed stiffness, one back-substitution per coordinate on the
# tangent that the solve left behind. A co-energy
#
#     Psi*(q, p) = g(p).q + p q'Cq / 2 + h(p) - q'Kq / 2
#
# is fitted to stiffness, equilibrium and enclosed volume together: K - p C is the condensed
# stiffness, dPsi*/dq = 0 the equilibrium, and dPsi*/dp the volume. One potential gives force
# and volume, so no energy is lost between gas and rod.
#
# The damping of a rod, identified from its motion.
#
# The equations of motion are tested with windows in time: over a window that begins and ends
# with weight zero,
#
#     D \int w v dt = \int (w f + w' M v) dt,
#
# where f holds all forces but damping. No acceleration of the samples is needed. D is the
# symmetric matrix that fits all windows best, one block for each strain, without the part that
# would add energy.
#
# Reference:
#     Messenger and Bortz, Weak SINDy for partial differential equations, J. Comput. Phys. 443,
#     2021, for tests with windows.


class PressureMap(AbstractPressureMap):
    """Work that gas at a gauge pressure can do on the coordinates and on the chamber walls.

    `force` and `walls` are coefficients of polynomials in p / `scale`: g(p), without a
    constant, and h(p). Good for pressures from 0 to about `scale`.

    Attributes:
        coupling: C, change of stiffness per pressure.
        force: Coefficients of g, powers 1, 2, ...
        walls: Coefficients of h [J], powers 1, 2, ...
        scale: Largest pressure of the path [Pa].
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


class ConstantDamping(AbstractDamping):
    """Linear damping by a constant matrix [N m s per coordinate rate]."""

    coefficients: Float[Array, "dof dof"] = eqx.field(converter=real)

    def matrix(self, stiffness):
        return self.coefficients


class Fit(eqx.Module):
    """The laws of a rod that stands in for the solid, and how well they were found.

    Attributes:
        section: Mean section: mass and rotary inertia about the line.
        length: Length of the line [m].
        elastic: Linear elastic law K.
        pressure: Pressure map.
        stiffness_error: Largest misfit of the condensed stiffness, relative.
        volume_error: Largest misfit of the enclosed volume, relative to its change.
    """

    section: Section
    length: Float[Array, ""]
    elastic: LinearElastic
    pressure: PressureMap
    stiffness_error: float
    volume_error: float

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
        Section, length, elastic law and pressure map of the rod, and the misfit of both.

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
    problem, load = path.problem, _pressure(path)
    if len(path) < degree + 2:
        raise ValueError(
            f"identify: the path holds {len(path)} states, need {degree + 2} for `degree` "
            f"{degree}. Solve at more pressures or lower `degree`."
        )
    p = np.asarray(path.values)
    q = np.asarray(coordinates(backbone, basis))
    at = probe(problem.mesh, curve, len(backbone.s), arm=arm, up=up)
    volumes, condensed = [], []
    for k, u in enumerate(path.displacements):
        condensed.append(_condensed_stiffness(path.problem_at(k), u, at, basis))
        volumes.append(float(enclosed_volume(problem, u, load.facets)))
        report("identify", len(volumes), len(p))
    K, C = _affine(p, np.stack(condensed))
    pressure = _pressure_map(p, q, np.array(volumes), K, C, degree)
    return Fit(
        section=mean_section(problem, curve, up=up),
        length=backbone.length,
        elastic=LinearElastic(K),
        pressure=pressure,
        stiffness_error=_relative(K - p[:, None, None] * C - np.stack(condensed), condensed),
        volume_error=_volume_error(pressure, p, q, np.array(volumes)),
    )


def _pressure(path: Path) -> Pressure:
    load = next(load for load in path.problem.loads if load.name == path.name)
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
) -> Float[np.ndarray, "steps dof dof"]:
    """Stiffness of the solid against forces on the coordinates, at each state of any path.

    That at rest is the elastic law of a rod: `LinearElastic(condensed_stiffness(...)[0])`.
    The arguments are those of `strain_along`.
    """
    at = probe(path.problem.mesh, curve, samples, arm=arm, up=up)
    found = [
        _condensed_stiffness(path.problem_at(k), u, at, basis)
        for k, u in enumerate(path.displacements)
    ]
    return np.stack(found)


def _condensed_stiffness(
    problem: Problem, u: Array, at: Probe, basis: StrainBasis
) -> Float[np.ndarray, "dof dof"]:
    """Stiffness against generalised forces on q at an equilibrium: (H K^-1 H')^-1."""
    H = _coordinate_jacobian(at, basis, u).reshape(basis.num_dof, -1)
    prepared = prepare(problem)
    tangent = linearise(problem, prepared, u, u).values
    matrix = sparse.fix(problem.space.system, tangent, prepared.known)
    rows = np.where(np.asarray(prepared.known), 0.0, np.asarray(H))
    answer = problem.space.system.solver.solve(np.asarray(matrix), rows)
    compliance = rows @ answer.T
    return np.linalg.inv((compliance + compliance.T) / 2)


@eqx.filter_jit
def _coordinate_jacobian(at: Probe, basis: StrainBasis, u):
    return jax.jacrev(lambda u: project(at.strain(u), at.s, basis))(u)


def _affine(p: np.ndarray, stiffness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """K and C of the least-squares fit K - p C, symmetric."""
    columns = np.stack([np.ones_like(p), -p], axis=1)
    flat = stiffness.reshape(len(p), -1)
    (K, C), *_ = np.linalg.lstsq(columns / np.abs(columns).max(0), flat, rcond=None)
    scale = np.abs(columns).max(0)
    shape = stiffness.shape[1:]
    return (K / scale[0]).reshape(shape), (C / scale[1]).reshape(shape)


def _pressure_map(p, q, volumes, K, C, degree) -> PressureMap:
    """g from the equilibria, then h from the volumes that remain."""
    scale = np.abs(p).max()
    x = p / scale
    push = q @ K - p[:, None] * (q @ C)
    powers = np.stack([x**k for k in range(1, degree + 1)], axis=1)
    force, *_ = np.linalg.lstsq(powers, push, rcond=None)
    slopes = np.stack([k * x ** (k - 1) for k in range(1, degree + 1)], axis=1) / scale
    bent = np.einsum("ki,ki->k", slopes @ force, q) + np.einsum("ki,ij,kj->k", q, C, q) / 2
    walls, *_ = np.linalg.lstsq(slopes * scale, (volumes - bent) * scale, rcond=None)
    return PressureMap(C, force, walls, scale)


def _volume_error(pressure: PressureMap, p, q, volumes) -> float:
    found = _volumes(pressure, jnp.asarray(q), jnp.asarray(p))
    return float(np.max(np.abs(np.asarray(found) - volumes)) / np.ptp(volumes))


@eqx.filter_jit
def _volumes(pressure: PressureMap, q: Array, p: Array) -> Float[Array, " steps"]:
    return jax.vmap(jax.grad(pressure.coenergy, argnums=1))(q, p)


def _relative(error: np.ndarray, reference) -> float:
    return float(np.max(np.abs(error)) / np.max(np.abs(np.stack(reference))))


def _powers(x: Float[Array, ""], count: int) -> Float[Array, " powers"]:
    return jnp.stack([x**k for k in range(1, count + 1)])


# The damping of a rod, identified from its motion


_FLAT = 8  # how flat a window ends; sums over samples are then as good as integrals
_SEEN = 1e-9  # least share of the motion at which a shape of the damping can be told


class DampingFit(eqx.Module):
    """Damping found in a motion.

    Attributes:
        damping: As a force on the rod.
        error: What it leaves unexplained of the force that damping must make [-].
    """

    damping: ConstantDamping
    error: float


def identify_damping(
    rod: Rod,
    t: Float[Array, " samples"],
    q: Float[Array, "samples dof"],
    forces: Forces = (),
    *,
    v: Float[Array, "samples dof"] | None = None,
    window: int = 21,
) -> DampingFit:
    """Damping matrix, a block per active strain, of a rod that was seen to move so.

    A free swing after a push will do, if it moves all coordinates. Coordinates of a FEM
    solution come from `strain_along` and `coordinates`.

    Args:
        rod: The rod, with its mass and stiffness.
        t: Equally spaced times [s], some twenty or more in a period of the fastest motion.
        q: Coordinates at these.
        forces: All forces on it but the damping; an elastic law replaces that of the rod.
        v: Rates [per s]; differences of order 4 if omitted.
        window: Samples in a window. More average noise away, up to about a period.

    Raises:
        ValueError: If times are not equally spaced, samples too few for a window, or a
            strain does not move in as many ways as it has coordinates.
    """
    times, states = np.asarray(t, float), np.asarray(q, float)
    _check.shape("identify_damping", "q", states, (len(times), rod.basis.num_dof), _ROWS)
    step = _step(times, window)
    rates = _differences(states, step) if v is None else np.asarray(v, float)
    _check.shape("identify_damping", "v", rates, states.shape, _ROWS)
    terms = _balance(rod, real(times), real(states), real(rates), forces)
    stiffness = np.diag(np.asarray(stiffness_matrix(rod)))
    momentum, force = (np.asarray(term) for term in terms)
    weight, slope = _windows(len(times), window, step)
    moved, lost = weight @ rates, weight @ force + slope @ momentum
    size = np.sqrt(stiffness)  # forces and rates of all coordinates in one measure
    moved, lost = moved * size, lost / size
    matrix = np.zeros((rod.basis.num_dof,) * 2)
    for name in rod.basis.active:
        at = columns(rod.basis, name)
        matrix[at, at] = _symmetric_fit(name, moved[:, at], lost[:, at])
    left = np.linalg.norm(moved @ matrix - lost) / np.linalg.norm(lost)
    return DampingFit(ConstantDamping(size[:, None] * matrix * size), float(left))


_ROWS = "Give one row of all coordinates for each time."


def _step(times: np.ndarray, window: int) -> float:
    if window < 5 or len(times) < 2 * window:
        raise ValueError(
            f"identify_damping: got {len(times)} samples and a window of {window}, need a "
            "window of 5 or more and twice its samples. Sample for longer or more often."
        )
    steps = np.diff(times)
    if not np.allclose(steps, steps.mean(), rtol=1e-3, atol=0) or steps.mean() <= 0:
        raise ValueError(
            f"identify_damping: got steps of {steps.min():.3g} to {steps.max():.3g} s between "
            "the samples, need equal ones. Interpolate to equally spaced times."
        )
    return float(steps.mean())


@eqx.filter_jit
def _balance(rod: Rod, t, q, v, forces) -> tuple[Array, Array]:
    """Momentum M v, and the force that changes it but for damping, of each sample."""
    constants = operators(rod)

    def at(t, q, v):
        moment = motion(rod, q, v, constants=constants)
        mass, coriolis = inertia(moment)

        def momentum(q):
            return inertia(motion(rod, q, constants=constants))[0] @ v

        _, growth = jax.jvp(momentum, (q,), (v,))
        return mass @ v, total_force(forces, t, moment) - coriolis + growth

    return jax.vmap(at)(t, q, v)


def _windows(samples: int, window: int, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows that integrate with the weight of each window, and with its slope in time."""
    half = (window - 1) / 2
    x = np.arange(window) / half - 1
    weight = step * (1 - x**2) ** _FLAT
    slope = -2 * _FLAT * x * (1 - x**2) ** (_FLAT - 1) / half
    starts = np.arange(0, samples - window + 1, max(1, window // 4))
    rows = np.zeros((2, len(starts), samples))
    for row, start in enumerate(starts):
        rows[:, row, start : start + window] = weight, slope
    return rows[0], rows[1]


def _symmetric_fit(name: str, x: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The symmetric D of least |x D - b| without its negative part."""
    squares, axes = np.linalg.eigh(x.T @ x)
    if not squares[0] > _SEEN * squares[-1]:
        raise ValueError(
            f"identify_damping: the {len(squares)} coordinates of `{name}` move in fewer ways "
            "than that, need all to move. Push the rod elsewhere or take fewer modes."
        )
    both = axes.T @ (x.T @ b + b.T @ x) @ axes
    found = axes @ (both / (squares[:, None] + squares)) @ axes.T
    values, directions = np.linalg.eigh(found)
    return (directions * np.maximum(values, 0)) @ directions.T


def _differences(q: np.ndarray, step: float) -> np.ndarray:
    """Slopes at the samples, of order 4, by five of them."""
    v = np.empty_like(q)
    v[2:-2] = (8 * (q[3:-1] - q[1:-3]) - (q[4:] - q[:-4])) / 12
    ends = np.array([[-25, 48, -36, 16, -3], [-3, -10, 18, -6, 1]]) / 12
    v[:2] = ends @ q[:5]
    v[-2:] = -(ends @ q[:-6:-1])[::-1]
    return v / step
