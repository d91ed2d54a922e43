"""Stresses of homogeneous deformations: what a testing machine would show.

Faces without grips are free: the stretch across is found by Newton's method on the
energy, whatever the material's compressibility. The stress is NaN where none is found.
Made for isotropic materials; a `FibreReinforced` one may lie along the first axis.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.material.hyperelastic import AbstractHyperelastic, strain_energy_density
from sorojax.material.kinematics import Entry, Tensor
from sorojax.math.implicit_root import implicit_root

MAX_ITERATIONS = 60
LONGEST_STEP = 0.3  # of the logarithm of the stretch across


def uniaxial_stress(
    material: AbstractHyperelastic, stretch: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Engineering stress [Pa] of a bar at `stretch` with free sides."""
    return _stress(material, stretch, stretch**-0.5, lambda l, t: _diagonal(l, t, t))


def equibiaxial_stress(
    material: AbstractHyperelastic, stretch: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Engineering stress [Pa] of a sheet at `stretch` in both directions with free faces."""
    return _stress(material, stretch, stretch**-2.0, lambda l, t: _diagonal(l, l, t)) / 2


def pure_shear_stress(
    material: AbstractHyperelastic, stretch: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Engineering stress [Pa] of a wide strip at `stretch`, held in width, with free faces."""

    def state(l, t):
        return _diagonal(l, jnp.ones_like(l), t)

    return _stress(material, stretch, 1 / stretch, state)


def simple_shear_stress(
    material: AbstractHyperelastic, shear: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Shear stress [Pa] of a block sheared by F = I + `shear` e1 e2."""

    def energy(g):
        one = jnp.ones_like(g)
        F = ((one, g, 0.0), (0.0, one, 0.0), (0.0, 0.0, 1.0))
        return jnp.sum(strain_energy_density(material, F))

    return jax.grad(energy)(shear)


def lateral_stretch(
    material: AbstractHyperelastic, stretch: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Stretch across a bar at `stretch` with free sides [-]."""
    return _free_stretch(material, stretch, stretch**-0.5, lambda l, t: _diagonal(l, t, t))


State = Callable[[Entry, Entry], Tensor]


def _diagonal(a: Entry, b: Entry, c: Entry) -> Tensor:
    return ((a, 0.0, 0.0), (0.0, b, 0.0), (0.0, 0.0, c))


def _stress(material, stretch, start, state: State):
    across = _free_stretch(material, stretch, start, state)

    def energy(stretch):
        return jnp.sum(strain_energy_density(material, state(stretch, across)))

    return jax.grad(energy)(stretch)


def _free_stretch(material, stretch, start, state: State):
    def slope(log):
        def energy(log):
            return jnp.sum(strain_energy_density(material, state(stretch, jnp.exp(log))))

        return jax.grad(energy)(log)

    def tangent_solve(linear, target):  # every point by itself
        return target / linear(jnp.ones_like(target))

    return jnp.exp(implicit_root(slope, jnp.log(start), _newton, tangent_solve))


def _newton(function: Callable[[Entry], Entry], start: Entry) -> Entry:
    """Root of an elementwise function; NaN where it is not found."""
    small = 64 * jnp.finfo(start.dtype).eps

    def iterate(carry):
        at, _, count = carry
        value, rate = jax.jvp(function, (at,), (jnp.ones_like(at),))
        # where the energy is not convex, downhill
        move = jnp.where(rate > 0, -value / rate, -jnp.sign(value))
        move = jnp.clip(move, -LONGEST_STEP, LONGEST_STEP)
        return at + move, jnp.abs(move), count + 1

    def unfinished(carry):
        return jnp.any(carry[1] > small) & (carry[2] < MAX_ITERATIONS)

    begin = (start, jnp.full_like(start, jnp.inf), 0)
    root, move, _ = jax.lax.while_loop(unfinished, iterate, begin)
    return jnp.where(move <= jnp.sqrt(small), root, jnp.nan)
