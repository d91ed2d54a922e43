"""What the branches of a viscoelastic rod remember, bear, store and dissipate.

Branch i has the generalised force -K_i (q - z_i) with dz_i/dt = (q - z_i) / tau_i; its
`memory` z_i has the units of the coordinates. Where q changes linearly in a step of x = h /
tau_i, with f = (1 - e^-x) / x,

    z_i(t + h) = e^-x z_i(t) + (f - e^-x) q(t) + (1 - f) q(t + h)

is exact: of order 2 for any motion, and stable at every step. The force at the end is linear in
q(t + h), so a step holds one more constant stiffness, the sum of f K_i, and a force that is
known when it begins. Stored are d_i' K_i d_i / 2 with d_i = q - z_i, dissipated d_i' K_i d_i /
tau_i, both never negative.

Reference:
    Simo and Hughes, Computational Inelasticity, 1998, chapter 10, for the recurrence.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.material.viscoelastic import Prony, branch_weights, uniaxial_spectrum
from sorojax.math.compiled import jit_public
from sorojax.math.ode.steppers import MemoryTerms
from sorojax.rod.forces.forces import AbstractElastic, Relaxation
from sorojax.rod.forces.loads import (
    Load,
    PartForce,
    parts_of,
    relaxation_of,
    relaxed,
    tangent_stiffness,
)
from sorojax.rod.model.assembly import (
    increments,
    num_coordinates,
    num_dof,
    rest,
    slices,
)
from sorojax.rod.model.model import Model, motion, operators
from sorojax.rod.model.rod import Rod

Memory = Float[Array, "branches dof"]
_UNIAXIAL = ("kappa_y", "kappa_z", "sigma_x")  # fibres that are pulled; others are sheared
_NO_TIME = 1e-30  # s, instead of a step of no length


class Branches(NamedTuple):
    """The branches of a model in the places of its rates.

    Attributes:
        shares: g_i of each coordinate [-], 0 where there is no branch.
        times: tau_i [s].
        stiffness: K, without coupling between coordinates of different shares.
    """

    shares: Float[Array, "branches dof"]
    times: Float[Array, "branches dof"]
    stiffness: Float[Array, "dof dof"]


class BranchEnergy(NamedTuple):
    """Energy `stored` in the branches [J], and the `power` that they dissipate [W]."""

    stored: Float[Array, "*states"]
    power: Float[Array, "*states"]


def branches_of(
    model: Model, forces: tuple[Load, ...], constants: Any = None
) -> Branches | None:
    """The branches among the forces on a model; None without any."""
    if all(relaxation_of(force) is None for force in forces):
        return None
    _check_parts(model, forces)
    constants = operators(model) if constants is None else constants
    start = rest(model)
    stiffness = tangent_stiffness(relaxed(forces), motion(model, start, constants=constants))
    found = [
        (at, *_spectrum_along(rod, listed[0], _is_replaced(forces, name)))
        for name, rod, at in _rods(model)
        if (listed := _listed(forces, name))
    ]
    size = (max(own.shape[0] for _, own, _ in found), num_dof(model))
    shares, times = jnp.zeros(size, start.dtype), jnp.ones(size, start.dtype)
    kept = jnp.zeros_like(stiffness)
    for at, own, tau in found:
        shares = shares.at[: own.shape[0], at].set(own.astype(start.dtype))
        times = times.at[: own.shape[0], at].set(tau.astype(start.dtype))
        kept = kept.at[at, at].set((stiffness[at, at] + stiffness[at, at].T) / 2)
    return Branches(shares, times, kept)


def _check_parts(model: Model, forces: tuple[Load, ...]) -> None:
    """Refuse branches that are on no rod."""
    names = [name for name, *_ in _rods(model)]
    rods = "no name on a single rod" if isinstance(model, Rod) else f"a rod among {names}"
    for force in forces:
        on = parts_of(force)
        if relaxation_of(force) and not (names if on == () else on[0] in names):
            raise ValueError(
                f"rod: a Relaxation is on {on[0] if on else 'an assembly'}, need {rods}. "
                "Wrap it, PartForce(name, Relaxation(spectrum)), or take the name off."
            )


def _rods(model: Model) -> list[tuple[str | None, Rod, slice]]:
    """Names of the rods, and the places of their rates."""
    if isinstance(model, Rod):
        return [(None, model, slice(0, model.basis.num_dof))]
    parts = zip(model.names, model.parts, slices(model), strict=True)
    return [(name, p.body, at.rod_v) for name, p, at in parts if isinstance(p.body, Rod)]


def _listed(forces: tuple[Load, ...], name: str | None) -> list[Relaxation]:
    """The one that is on a rod, if any."""
    found = [
        branches
        for force in forces
        if (branches := relaxation_of(force)) and parts_of(force) in ((), (name,))
    ]
    if len(found) > 1:
        raise ValueError(
            f"rod: got {len(found)} Relaxations on one rod, need at most one. List all "
            "branches in one spectrum."
        )
    return found


def _is_replaced(forces: tuple[Load, ...], name: str | None) -> bool:
    """Whether a law takes the place of the rod's own elasticity."""
    own = [
        force.force if isinstance(force, PartForce) else force
        for force in forces
        if parts_of(force) in ((), (name,))
    ]
    return any(isinstance(force, AbstractElastic) for force in own)


def _spectrum_along(rod: Rod, force: Relaxation, replaced: bool) -> tuple[Array, Array]:
    """Shares and times of the branches of each coordinate of a rod."""
    shear = _stacked(force.spectrum)
    if replaced:
        pull = shear
    else:
        ratio, do = rod.material.poisson_ratio, "Give the rod one number."
        _check.shape("Relaxation", "poisson_ratio", ratio, (), do)
        pull = _stacked(uniaxial_spectrum(force.spectrum, ratio))
    rows = []
    for name in rod.basis.active:
        own, count = pull if name in _UNIAXIAL else shear, rod.basis.modes[name].count
        rows.append([jnp.repeat(x[:, None], count, axis=1) for x in own])
    shares, times = (jnp.concatenate(x, axis=1) for x in zip(*rows, strict=True))
    return shares, times


def _stacked(spectrum: Prony) -> tuple[Array, Array]:
    return jnp.stack(spectrum.shares), jnp.stack(spectrum.times)


def memory_terms(
    model: Model, forces: tuple[Load, ...], constants: Any, q: Array, memory: Any = None
) -> MemoryTerms | None:
    """The branches among the forces as steppers take them, from `memory`, or relaxed at `q`;
    None without any."""
    branches = branches_of(model, forces, constants)
    if branches is None:
        if memory is not None:
            raise ValueError(
                "rod: got a `memory` and no Relaxation among the forces, need one. List it, "
                "or leave the memory out."
            )
        return None

    def within(span, q, memory):
        known, slack = _in_step(branches, span, increments(model, q), memory)
        stiffness = branches.stiffness * slack[None]
        return lambda new: known - stiffness @ increments(model, new), stiffness

    def after(h, q, new, memory):
        return _after(branches, h, increments(model, q), increments(model, new), memory)

    return MemoryTerms(
        begun(branches, increments(model, q)) if memory is None else _given(branches, memory),
        lambda q, memory: memory_rate(branches, increments(model, q), memory),
        lambda q, memory: borne(branches, increments(model, q), memory),
        within,
        after,
    )


def begun(branches: Branches, x: Array) -> Memory:
    """The memory of branches that have relaxed at coordinates x."""
    return jnp.broadcast_to(x[None], branches.shares.shape)


def _given(branches: Branches, memory: Any) -> Memory:
    do = "Give one row per branch, as in `memory` of a Trajectory."
    _check.shape("rod", "memory", memory, branches.shares.shape, do)
    return real(memory).astype(branches.shares.dtype)


def borne(branches: Branches, x: Array, memory: Memory) -> Array:
    """Generalised force of the branches."""
    return branches.stiffness @ jnp.sum(branches.shares * (memory - x[None]), axis=0)


def memory_rate(branches: Branches, x: Array, memory: Memory) -> Memory:
    """Rate of the memory [1/s]."""
    return (x[None] - memory) / branches.times


def _weights(branches: Branches, h: Array):
    return branch_weights(branches.times, jnp.where(h == 0, _NO_TIME, h))


def _in_step(branches: Branches, h: Array, x: Array, memory: Memory) -> tuple[Array, Array]:
    """The force `h` [s] after x at coordinates of zero, and the sum of f g_i: what a coordinate
    takes from it, times the stiffness."""
    decay, before, after = _weights(branches, h)
    held = jnp.sum(branches.shares * (decay * memory + before * x[None]), axis=0)
    return branches.stiffness @ held, jnp.sum(branches.shares * (1 - after), axis=0)


def _after(branches: Branches, h: Array, x: Array, new: Array, memory: Memory) -> Memory:
    decay, before, after = _weights(branches, h)
    return decay * memory + before * x[None] + after * new[None]


# Along a motion that is known


@jit_public
def branch_states(
    model: Model,
    forces: tuple[Load, ...],
    times: Numbers,
    q: Float[Array, "times coordinates"],
) -> Float[Array, "times branches dof"]:
    """What the branches of a `Relaxation` remember along a motion that is known.

    The rod is relaxed at the first coordinates; between two times they change linearly, for
    which each step is exact. Of a spectrum of n branches row i are the coordinates, curvature
    modes in [1/m], at which branch i is free of force.

    Args:
        model: The rod or assembly.
        forces: With a `Relaxation`, and the elastic law that replaces that of a rod if any.
        times: Increasing times [s].
        q: Coordinates at each.

    Returns:
        The memory at each time, for `branch_force` and `branch_energy`.

    Raises:
        ValueError: If there is no `Relaxation`, or the shapes do not fit.

    Example:
        >>> finger = rod.rod(SE2(), rod.chebyshev(kappa_z=1), rod.circle(5 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> branches = (rod.Relaxation(material.Prony([0.5], [0.1])),)
        >>> times, q = jnp.array([0, 1e-9, 0.1]), jnp.array([[0.0], [5.0], [5.0]])  # held bent
        >>> z = rod.branch_states(finger, branches, times, q)
        >>> print([round(float(x), 3) for x in z[:, 0, 0]])
        [0.0, 0.0, 3.161]

    Reference:
        Simo and Hughes, Computational Inelasticity, 1998, chapter 10.
    """
    times, q = real(times), real(q)
    _check.shape("branch_states", "times", times, (None,), "Give a list of times.")
    do = "Give the coordinates at each time."
    _check.shape("branch_states", "q", q, (times.shape[0], num_coordinates(model)), do)
    branches = _some("branch_states", model, forces)
    x = jax.vmap(lambda q: increments(model, q))(q)

    def advance(memory, row):
        new = _after(branches, *row, memory)
        return new, new

    begin = begun(branches, x[0])
    _, states = jax.lax.scan(advance, begin, (jnp.diff(times), x[:-1], x[1:]))
    return jnp.concatenate([begin[None], states])


@jit_public
def branch_force(
    model: Model,
    forces: tuple[Load, ...],
    q: Float[Array, "*states coordinates"],
    memory: Float[Array, "*states branches dof"],
) -> Float[Array, "*states dof"]:
    """Generalised force of the branches, the sum of K_i (z_i - q), of one state or many: what
    they add to `inverse_dynamics` or `total_force` of the other forces.

    Args:
        model: The rod or assembly.
        forces: With a `Relaxation`, as for `branch_states`.
        q: Coordinates.
        memory: What the branches remember there.

    Returns:
        Generalised force, on the right of the equations of motion.
    """
    branches = _some("branch_force", model, forces)
    return _each(branches, lambda x, z: borne(branches, x, z), model, q, memory)


@jit_public
def branch_energy(
    model: Model,
    forces: tuple[Load, ...],
    q: Float[Array, "*states coordinates"],
    memory: Float[Array, "*states branches dof"],
) -> BranchEnergy:
    """Energy that the branches store, the sum of (q - z_i)' K_i (q - z_i) / 2, and the power
    that they dissipate, 2 / tau_i of each; neither is ever negative.

    Args:
        model: The rod or assembly.
        forces: With a `Relaxation`, as for `branch_states`.
        q: Coordinates, of one state or many.
        memory: What the branches remember there.

    Returns:
        Stored energy [J] and dissipated power [W] of each state.
    """
    branches = _some("branch_energy", model, forces)

    def one(x, memory):
        away = x[None] - memory
        pull = branches.shares * (away @ branches.stiffness)
        power = jnp.sum(away * pull / branches.times)
        return BranchEnergy(jnp.sum(away * pull) / 2, power)

    return _each(branches, one, model, q, memory)


def _some(where: str, model: Model, forces: tuple[Load, ...]) -> Branches:
    branches = branches_of(model, forces)
    if branches is None:
        raise ValueError(
            f"{where}: got no Relaxation among the forces, need one. List "
            "rod.Relaxation(material.Prony(shares, times))."
        )
    return branches


def _each(branches: Branches, one: Any, model: Model, q: Array, memory: Array) -> Any:
    """`one` of each state."""
    if q.ndim > 1:
        return jax.vmap(lambda q, z: _each(branches, one, model, q, z))(q, memory)
    return one(increments(model, q), _given(branches, memory))
