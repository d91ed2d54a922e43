"""What a body remembers at every quadrature point, and the material that this makes of it
within a step and at an instant: strains of the branches where it is viscoelastic, the largest
energy so far, its peak, where it softens.

A row of strains holds entries of symmetric tensors by `viscoelastic.pairs`: the first is C^-1
of the isochoric strain C, the others the A_i of the branches; see `material.viscoelastic`. A
body of another material has none, and each function here gives `None`, or the body itself.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._jax.jit import once
from sorojax.fem.assembly.geometry import Points, deformation, quadrature_points
from sorojax.fem.problem import Problem, exchanged, potential_energy
from sorojax.fem.stress import full_deformation
from sorojax.material.hyperelastic import AbstractHyperelastic
from sorojax.material.kinematics import Tensor
from sorojax.material.softening.law import (
    Softening,
    dissipated_energy,
    raised,
    remembering,
    with_peak,
)
from sorojax.material.viscoelastic import (
    Overstressed,
    Prony,
    Sym,
    Terms,
    Viscoelastic,
    borne,
    branch_moduli,
    dissipation,
    free_energy,
    inverse_strain,
    relaxed_by,
    remembered,
    step_weights,
)
from sorojax.math.compiled import apart

Strains = Float[Array, "rows entries quad cells"]
Peaks = Float[Array, "quad cells"]
Nodal = Float[Array, "nodes dim"]


def moduli(problem: Problem) -> Terms | None:
    """Shear moduli of the branches [Pa], computed once per motion."""
    material = problem.material
    return branch_moduli(material) if isinstance(material, Viscoelastic) else None


class Past(eqx.Module):
    """What a body brings along on a path: moduli [Pa] and strains, if it is one over time, and
    peaks [J/m^3]."""

    moduli: Terms | None
    strains: Strains | None
    peaks: Peaks | None


@once
def from_past(problem: Problem, past: Past, step: Float[Array, ""] | None) -> Problem:
    """`problem` with the material `step` [s] after the `past`."""
    material = in_step(problem, past.moduli, past.strains, step, past.peaks)
    return exchanged(problem, material=material[0]) if material else problem


@once
def next_past(problem: Problem, past: Past, step: Float[Array, ""] | None, u: Nodal) -> Past:
    """The past after a `step` [s] to equilibrium at `u` [m]."""
    args = problem, past.moduli, past.strains, step, u, past.peaks
    return Past(past.moduli, after_step(*args)[0], raised_peaks(*args)[0])


@once
def first_past(problem: Problem, u: Nodal, timed: bool) -> Past:
    """The past of a body that has relaxed at `u` [m]; without branches unless `timed`."""
    peaks = first_peaks(problem, u)
    if not timed:
        return Past(None, None, peaks)
    return Past(moduli(problem), relaxed(problem, u), peaks)


@once
def relaxed(problem: Problem, u: Nodal) -> Strains | None:
    """The strains of a body that has been at displacement `u` [m] for long."""
    if not isinstance(problem.material, Viscoelastic):
        return None
    first = jnp.stack(_inverse(problem, quadrature_points(problem.mesh, problem.kinematics), u))
    count = len(problem.material.relaxation.shares)
    return jnp.broadcast_to(first, (1 + count, *first.shape))


def first_peaks(problem: Problem, u: Nodal) -> Peaks | None:
    """The peaks of a body that softens and is brought to `u` [m] by its first motion."""
    return _first_peaks(problem, u) if softens(problem) else None


@once
def _first_peaks(problem: Problem, u: Nodal) -> Peaks:
    points, law = quadrature_points(problem.mesh, problem.kinematics), _softening(problem)
    assert law is not None
    peaks = raised(_by_point(law), _deformation(problem, points, u))
    return jnp.broadcast_to(peaks, points.volumes.shape)


def in_step(
    problem: Problem,
    moduli: Terms | None,
    strains: Strains | None,
    step: Float[Array, ""] | None,
    peaks: Peaks | None = None,
) -> tuple[AbstractHyperelastic, ...]:
    """The material `step` [s] after the strains and peaks, as what `with_terms` takes beside
    loads and supports."""
    if moduli is None or strains is None:
        return () if peaks is None else (_base(problem, peaks),)
    assert step is not None
    weights = step_weights(_spectrum(problem), step)
    stress = remembered(_by_point(moduli), weights, _rows(strains))
    return (Overstressed(_base(problem, peaks), jnp.stack(stress)),)


def after_step(
    problem: Problem,
    moduli: Terms | None,
    strains: Strains | None,
    step: Float[Array, ""] | None,
    u: Nodal,
    peaks: Peaks | None = None,
) -> tuple[Strains | None, Float[Array, ""]]:
    """The strains after a `step` [s] that ends at displacement `u` [m], and what the branches
    dissipate in it [J]."""
    if moduli is None or strains is None:
        return None, jnp.zeros((), u.dtype)
    assert step is not None
    spectrum, alone = _spectrum(problem), apart(step > 0)
    points = quadrature_points(problem.mesh, problem.kinematics)
    (ended,) = in_step(problem, moduli, strains, step, peaks)
    inverse = alone(lambda: _inverse(exchanged(problem, material=ended), points, u))
    rows = relaxed_by(step_weights(spectrum, step), _rows(strains), inverse)
    new = jnp.stack([jnp.stack(row) for row in rows])
    mean = _rows((strains + new) / 2)
    rates = alone(lambda: dissipation(_by_point(moduli), spectrum, mean))
    return new, step * jnp.sum(points.volumes * rates)


def raised_peaks(
    problem: Problem,
    moduli: Terms | None,
    strains: Strains | None,
    step: Float[Array, ""] | None,
    u: Nodal,
    peaks: Peaks | None,
) -> tuple[Peaks | None, Float[Array, ""]]:
    """The peaks after a step that ends at displacement `u` [m], and what softening dissipates
    in it [J]."""
    if peaks is None:
        return None, jnp.zeros((), u.dtype)
    points, law = quadrature_points(problem.mesh, problem.kinematics), _softening(problem)
    assert law is not None
    (ended,) = in_step(problem, moduli, strains, step, peaks)
    F = _deformation(exchanged(problem, material=ended), points, u)
    law = _by_point(with_peak(law, peaks))
    new = raised(law, F)
    taken = dissipated_energy(law, new) - dissipated_energy(law, peaks)
    return new, jnp.sum(points.volumes * taken)


def strain_rates(
    problem: Problem, moduli: Terms | None, strains: Strains, u: Nodal, v: Nodal
) -> tuple[Strains, Float[Array, ""]]:
    """Rates of the strains [1/s], and the power that the branches dissipate [W], of a body at
    displacement `u` [m] with velocity `v` [m/s]."""
    assert moduli is not None
    spectrum, rows = _spectrum(problem), _rows(strains)
    points = quadrature_points(problem.mesh, problem.kinematics)
    states = [
        jnp.stack([(c - a) / tau for c, a in zip(rows[0], state, strict=True)])
        for tau, state in zip(spectrum.times, rows[1:], strict=True)
    ]

    def inverse(strains, u):
        return jnp.stack(_inverse(at_instant(problem, moduli, strains), points, u))

    along = jnp.stack([jnp.zeros_like(states[0]), *states])
    first = jax.jvp(inverse, (strains, u), (along, v))[1]
    rates = dissipation(_by_point(moduli), spectrum, rows)
    return jnp.stack([first, *states]), jnp.sum(points.volumes * rates)


def stored_energy(
    problem: Problem,
    moduli: Terms | None,
    strains: Strains | None,
    u: Nodal,
    peaks: Peaks | None = None,
) -> Float[Array, ""]:
    """Energy of a body without loads and of its branches that it can give back [J]."""
    now = potential_energy(at_instant(problem, moduli, strains, peaks), u)
    if moduli is None or strains is None:
        return now
    points, rows = quadrature_points(problem.mesh, problem.kinematics), _rows(strains)
    return now + jnp.sum(points.volumes * free_energy(_by_point(moduli), rows))


def at_instant(
    problem: Problem, moduli: Terms | None, strains: Strains | None, peaks: Peaks | None = None
) -> Problem:
    """`problem` with the material whose stress is that of the body at an instant."""
    if moduli is None or strains is None:
        return problem if peaks is None else exchanged(problem, material=_base(problem, peaks))
    stress = jnp.stack(borne(_by_point(moduli), _rows(strains)))
    return exchanged(problem, material=Overstressed(_base(problem, peaks), stress))


def _base(problem: Problem, peaks: Peaks | None) -> AbstractHyperelastic:
    """The law without branches, with the peaks of a body that softens."""
    material = problem.material
    base = material.base if isinstance(material, Viscoelastic) else material
    if peaks is None:
        return base
    assert isinstance(base, Softening)
    return with_peak(base, peaks)


def _softening(problem: Problem) -> Softening | None:
    return remembering(_base(problem, None))


def softens(problem: Problem) -> bool:
    """Whether a body remembers its largest energies."""
    return _softening(problem) is not None


def _spectrum(problem: Problem) -> Prony:
    assert isinstance(problem.material, Viscoelastic)
    return _by_point(problem.material.relaxation)


def _by_point(tree: Any) -> Any:
    """`tree` with numbers per cell that fit (quad, cells)."""
    return jax.tree.map(lambda leaf: leaf[None] if jnp.ndim(leaf) == 1 else leaf, tree)


def _rows(strains: Strains) -> list[Sym]:
    return [tuple(row) for row in strains]


def _inverse(problem: Problem, points: Points, u: Nodal) -> Sym:
    """C^-1 of the isochoric strain at the points."""
    return inverse_strain(_deformation(problem, points, u))


def _deformation(problem: Problem, points: Points, u: Nodal) -> Tensor:
    F = deformation(problem.mesh, problem.kinematics, points, u)
    return full_deformation(problem, points, F)
