"""Closed cavities: what is inside them, and equilibrium with it.

The pressure of a cavity is an unknown that a law of its contents determines: a given
volume of liquid, or a gas. The tangent is bordered by one row per cavity.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._progress import report
from sorojax._types import real
from sorojax.fem.bordered import Border, newton_bordered
from sorojax.fem.energy_form import load_force, load_potential
from sorojax.fem.follow import LoadStep, Log, between
from sorojax.fem.linear import prepare
from sorojax.fem.problem import Problem
from sorojax.fem.supports import known_values


class AbstractContents(eqx.Module):
    """What fills a cavity: the volume that it takes at a pressure."""

    @abc.abstractmethod
    def volume_at(self, pressure: Float[Array, ""]) -> Float[Array, ""]:
        """Volume [m^3] at a gauge pressure [Pa]."""


class Liquid(AbstractContents):
    """A liquid that takes `volume` [m^3] at no gauge pressure; without `bulk_modulus` [Pa]
    it is incompressible: the cavity is controlled by its volume."""

    volume: Float[Array, ""] = eqx.field(converter=real)
    bulk_modulus: Float[Array, ""] = eqx.field(converter=real, default=np.inf)

    def __check_init__(self):
        _check.positive("Liquid", "volume", self.volume, "m^3", "Write 20e-6, for example.")

    def volume_at(self, pressure):
        return self.volume * jnp.exp(-pressure / self.bulk_modulus)


class Gas(AbstractContents):
    """A sealed amount of gas: (pressure + ambient) volume^exponent is constant.

    It takes `volume` [m^3] at the gauge `pressure` [Pa]; `exponent` is 1 for slow and 1.4
    for fast changes of air. Where symmetry cuts the cavity `volume` is that of the part.
    """

    volume: Float[Array, ""] = eqx.field(converter=real)
    pressure: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    exponent: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    ambient: Float[Array, ""] = eqx.field(converter=real, default=101325.0)

    def __check_init__(self):
        _check.positive("Gas", "volume", self.volume, "m^3", "Write 20e-6, for example.")
        _check.positive("Gas", "exponent", self.exponent, "", "1 is isothermal, 1.4 adiabatic.")
        _check.positive("Gas", "pressure + ambient", self.pressure + self.ambient, "Pa",
                        "A gas cannot pull.")  # fmt: skip

    def volume_at(self, pressure):
        ratio = (self.pressure + self.ambient) / (pressure + self.ambient)
        return self.volume * ratio ** (1 / self.exponent)


Names = tuple[str, ...]


class CavityStart(eqx.Module):
    """A state to start from, and the loads it is in equilibrium with."""

    problem: Problem
    u: Float[Array, "nodes dim"]
    pressures: Float[Array, " cavities"]


def with_pressures(
    problem: Problem, names: Names, pressures: Float[Array, " cavities"]
) -> Problem:
    """`problem` with the loads called `names` set."""
    order = [load.name for load in problem.loads]
    indices = [order.index(name) for name in names]
    return eqx.tree_at(lambda p: [p.loads[i].value for i in indices], problem, list(pressures))


def volumes(
    problem: Problem, names: Names, u: Float[Array, "nodes dim"]
) -> Float[Array, " cavities"]:
    """Volumes [m^3] that the pressures called `names` work on."""

    def potential(pressures):
        return load_potential(with_pressures(problem, names, pressures), u)

    return -jax.grad(potential)(jnp.zeros(len(names), u.dtype))


@eqx.filter_jit
def contents_gap(
    problem: Problem, names: Names, contents: tuple[AbstractContents, ...], u, pressures
) -> Float[Array, " cavities"]:
    """Volume of the contents minus that of the cavities [m^3]."""
    return _wanted(contents, pressures) - volumes(problem, names, u)


def _wanted(contents: tuple[AbstractContents, ...], pressures):
    return jnp.stack([c.volume_at(p) for c, p in zip(contents, pressures, strict=True)])


@eqx.filter_jit
def _border(problem: Problem, names: Names, contents, begin, share, u, pressures) -> Border:
    """The border on the way from the volumes `begin` to those of the contents."""

    def wanted(pressures):
        return begin + share * (_wanted(contents, pressures) - begin)

    inside = volumes(problem, names, u)
    slope = jax.jacrev(lambda u: volumes(problem, names, u))(u).reshape(len(names), -1)
    known = known_values(problem.supports, *u.shape)
    # The potential is minus pressure times volume: B = C makes the border symmetric.
    return Border(
        force_rate=-slope,
        known=known,
        known_rate=jnp.zeros_like(slope),
        gap=wanted(pressures) - inside,
        gap_slope=-slope,
        gap_rate=jax.jacfwd(wanted)(pressures),
        scale=jnp.abs(inside),
    )


@eqx.filter_jit
def begin_volumes(problem: Problem, names: Names, u) -> Float[Array, " cavities"]:
    return volumes(problem, names, u)


def follow_contents(
    problem: Problem,
    names: Names,
    contents: tuple[AbstractContents, ...],
    begin: CavityStart,
    log: Log,
) -> tuple[np.ndarray, np.ndarray]:
    """Displacement and pressures at equilibrium with the contents, in adaptive steps."""
    prepared = prepare(problem)
    u, pressures = np.asarray(begin.u), np.asarray(begin.pressures)
    first = begin_volumes(problem, names, jnp.asarray(u))
    done, size, failures = 0.0, 1.0 / log.num_steps, 0
    while done < 1.0:
        goal = done + size if done + size < 1.0 - 1e-9 else 1.0

        def at(u, y, goal=goal):
            here = with_pressures(between(begin.problem, problem, goal), names, jnp.asarray(y))
            share, u = jnp.asarray(goal), jnp.asarray(u)
            return here, _border(here, names, contents, first, share, u, jnp.asarray(y))

        found = newton_bordered(at, prepared, u, pressures, log.newton)
        if found.reason:
            failures += 1
            log.cuts += 1
            if failures > log.max_cuts:
                log.reason = found.reason
                return u, pressures
            size = (goal - done) / 2
            continue
        u, pressures, done, failures = found.u, found.y, goal, 0
        log.steps.append(LoadStep(goal, found.iterations, found.residual, -1))
        report("contents", done, 1.0, iterations=found.iterations, cuts=log.cuts)
        if found.iterations <= 5:
            size *= 1.5
    return u, pressures


@eqx.filter_jit
def pressure_force_rate(
    problem: Problem, names: Names, u: Float[Array, "nodes dim"]
) -> Float[Array, "cavities dofs"]:
    """Nodal force of a unit pressure in each cavity: the slope of its volume [m^2]."""

    def force(pressures):
        return load_force(with_pressures(problem, names, pressures), u).ravel()

    return jax.jacfwd(force)(jnp.zeros(len(names), u.dtype)).T
