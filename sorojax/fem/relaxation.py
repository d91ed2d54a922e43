"""What the branches of a viscoelastic body remember: strains at every quadrature point, and the
material that they make of it within a step and at an instant.

A row of strains holds entries of symmetric tensors by `viscoelastic.pairs`: the first is C^-1
of the isochoric strain C, the others the A_i of the branches; see `material.viscoelastic`. A
body of another material has none, and each function here gives `None`, or the body itself.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.fem.assembly.geometry import Points, deformation, quadrature_points
from sorojax.fem.problem import Problem, exchanged, potential_energy
from sorojax.fem.stress import full_deformation
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
Nodal = Float[Array, "nodes dim"]


def moduli(problem: Problem) -> Terms | None:
    """Shear moduli of the branches [Pa], computed once per motion."""
    material = problem.material
    return branch_moduli(material) if isinstance(material, Viscoelastic) else None


class Past(eqx.Module):
    """What a body brings along on a path over time: moduli [Pa] and strains."""

    moduli: Terms | None
    strains: Strains | None


@eqx.filter_jit
def from_past(problem: Problem, past: Past, step: Float[Array, ""]) -> Problem:
    """`problem` with the material `step` [s] after the `past`."""
    material = in_step(problem, past.moduli, past.strains, step)
    return exchanged(problem, material=material[0]) if material else problem


@eqx.filter_jit
def next_past(problem: Problem, past: Past, step: Float[Array, ""], u: Nodal) -> Past:
    """The past after a `step` [s] to equilibrium at `u` [m]."""
    args = problem, past.moduli, past.strains, step, u
    return Past(past.moduli, after_step(*args)[0])


@eqx.filter_jit
def first_past(problem: Problem, u: Nodal) -> Past:
    """The past of a body that has relaxed at `u` [m]."""
    return Past(moduli(problem), relaxed(problem, u))


@eqx.filter_jit
def relaxed(problem: Problem, u: Nodal) -> Strains | None:
    """The strains of a body that has been at displacement `u` [m] for long."""
    if not isinstance(problem.material, Viscoelastic):
        return None
    first = jnp.stack(_inverse(problem, quadrature_points(problem.mesh, problem.kinematics), u))
    count = len(problem.material.relaxation.shares)
    return jnp.broadcast_to(first, (1 + count, *first.shape))


def in_step(
    problem: Problem, moduli: Terms | None, strains: Strains | None, step: Float[Array, ""]
) -> tuple[Overstressed, ...]:
    """The material `step` [s] after the strains, as what `with_terms` takes beside loads and
    supports."""
    if moduli is None or strains is None:
        return ()
    weights = step_weights(_spectrum(problem), step)
    stress = remembered(_by_point(moduli), weights, _rows(strains))
    return (Overstressed(_base(problem), jnp.stack(stress)),)


def after_step(
    problem: Problem,
    moduli: Terms | None,
    strains: Strains | None,
    step: Float[Array, ""],
    u: Nodal,
) -> tuple[Strains | None, Float[Array, ""]]:
    """The strains after a `step` [s] that ends at displacement `u` [m], and what the branches
    dissipate in it [J]."""
    if moduli is None or strains is None:
        return None, jnp.zeros((), u.dtype)
    spectrum, alone = _spectrum(problem), apart(step > 0)
    points = quadrature_points(problem.mesh, problem.kinematics)
    (ended,) = in_step(problem, moduli, strains, step)
    inverse = alone(lambda: _inverse(exchanged(problem, material=ended), points, u))
    rows = relaxed_by(step_weights(spectrum, step), _rows(strains), inverse)
    new = jnp.stack([jnp.stack(row) for row in rows])
    mean = _rows((strains + new) / 2)
    rates = alone(lambda: dissipation(_by_point(moduli), spectrum, mean))
    return new, step * jnp.sum(points.volumes * rates)


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
    problem: Problem, moduli: Terms | None, strains: Strains | None, u: Nodal
) -> Float[Array, ""]:
    """Energy of a body without loads and of its branches [J]."""
    if moduli is None or strains is None:
        return potential_energy(problem, u)
    points, rows = quadrature_points(problem.mesh, problem.kinematics), _rows(strains)
    rest = jnp.sum(points.volumes * free_energy(_by_point(moduli), rows))
    return potential_energy(at_instant(problem, moduli, strains), u) + rest


def at_instant(problem: Problem, moduli: Terms | None, strains: Strains | None) -> Problem:
    """`problem` with the material whose stress is that of the body at an instant."""
    if moduli is None or strains is None:
        return problem
    stress = jnp.stack(borne(_by_point(moduli), _rows(strains)))
    return exchanged(problem, material=Overstressed(_base(problem), stress))


def _base(problem: Problem):
    assert isinstance(problem.material, Viscoelastic)
    return problem.material.base


def _spectrum(problem: Problem) -> Prony:
    assert isinstance(problem.material, Viscoelastic)
    return _by_point(problem.material.relaxation)


def _by_point(tree: Any) -> Any:
    """`tree` with numbers per cell that fit (quad, cells)."""
    return jax.tree.map(lambda leaf: leaf[None] if jnp.ndim(leaf) else leaf, tree)


def _rows(strains: Strains) -> list[Sym]:
    return [tuple(row) for row in strains]


def _inverse(problem: Problem, points: Points, u: Nodal) -> Sym:
    """C^-1 of the isochoric strain at the points."""
    F = deformation(problem.mesh, problem.kinematics, points, u)
    return inverse_strain(full_deformation(problem, points, F))
