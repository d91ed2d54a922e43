"""A rod's elastic law, pressure map and section, identified from a FEM load path.

At every equilibrium of the path the solid answers a generalised force on the strain
coordinates q with its condensed stiffness, one back-substitution per coordinate on the
tangent that the solve left behind. A co-energy

    Psi*(q, p) = g(p).q + p q'Cq / 2 + h(p) - q'Kq / 2

is fitted to stiffness, equilibrium and enclosed volume together: K - p C is the condensed
stiffness, dPsi*/dq = 0 the equilibrium, and dPsi*/dp the volume. One potential gives force
and volume, so no energy is lost between gas and rod.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._progress import report
from sorojax._types import Numbers, real
from sorojax.fem.linear import linearise, prepare
from sorojax.fem.loads import Pressure
from sorojax.fem.problem import Problem
from sorojax.fem.solve import Path, with_load
from sorojax.fem.stress import enclosed_volume
from sorojax.math import sparse
from sorojax.reduction.backbone import Backbone, Probe, probe
from sorojax.reduction.curve import AbstractCurve
from sorojax.reduction.mass import mean_section
from sorojax.reduction.pod import coordinates, project
from sorojax.rod import (
    AbstractDamping,
    AbstractPressureMap,
    LinearElastic,
    Section,
    StrainBasis,
)


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
        return push @ q + pressure * (q @ self.coupling @ q) / 2 + (
            _powers(x, self.walls.shape[0]) @ self.walls
        )  # fmt: skip


class ConstantDamping(AbstractDamping):
    """Linear damping by a constant matrix [N m s per coordinate rate]."""

    coefficients: Float[Array, "dof dof"] = eqx.field(converter=real)

    def matrix(self, stiffness):
        return self.coefficients


class Fit(eqx.Module):
    """What a rod needs to stand in for the solid, and how well it was found.

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
    """Identify a rod along `curve` from a path of pressures.

    Args:
        path: Equilibria for values of one `Pressure` load.
        basis: Modes, e.g. from `pod_basis`.
        backbone: Snapshots of the same path along `curve`.
        curve: The material curve, in the plane or in space.
        degree: Highest power of the pressure in the map.
        arm, up: As given to `strain_along`.

    Raises:
        ValueError: If the path is not driven by a pressure, or has too few states.
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
    for u, value in zip(path.displacements, path.values, strict=True):
        here = with_load(problem, path.name, value)
        condensed.append(_condensed_stiffness(here, u, at, basis))
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
        _condensed_stiffness(with_load(path.problem, path.name, value), u, at, basis)
        for u, value in zip(path.displacements, path.values, strict=True)
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
