"""Stresses of homogeneous deformations: what a testing machine would show.

Faces without grips are free: the stretch across is found by Newton's method on the
energy, whatever the material's compressibility. The stress is NaN where none is found.
Made for isotropic materials; a `FibreReinforced` one may lie along the first axis.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.jit import once
from sorojax.material.hyperelastic import AbstractHyperelastic, strain_energy_density
from sorojax.material.kinematics import Entry, Tensor
from sorojax.math.implicit_root import implicit_root

MAX_ITERATIONS = 60
LONGEST_STEP = 0.3  # of the logarithm of the stretch across


def uniaxial_stress(
    material: AbstractHyperelastic, stretch: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Engineering stress [Pa] of a bar at `stretch` with free sides.

    Args:
        material: The material.
        stretch: Length over that at rest [-].

    Returns:
        Stress [Pa].
    """
    return _stress(material, stretch, stretch**-0.5, lambda l, t: _diagonal(l, t, t))


def equibiaxial_stress(
    material: AbstractHyperelastic, stretch: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Engineering stress [Pa] of a sheet at `stretch` in both directions with free faces.

    Args:
        material: The material.
        stretch: Length over that at rest [-].

    Returns:
        Stress [Pa].
    """
    return _stress(material, stretch, stretch**-2.0, lambda l, t: _diagonal(l, l, t)) / 2


def pure_shear_stress(
    material: AbstractHyperelastic, stretch: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Engineering stress [Pa] of a wide strip at `stretch`, held in width, with free faces.

    Args:
        material: The material.
        stretch: Length over that at rest [-].

    Returns:
        Stress [Pa].
    """

    def state(l, t):
        return _diagonal(l, jnp.ones_like(l), t)

    return _stress(material, stretch, 1 / stretch, state)


def simple_shear_stress(
    material: AbstractHyperelastic, shear: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Shear stress [Pa] of a block sheared by F = I + `shear` e1 e2.

    Args:
        material: The material.
        shear: Tangent of the angle of shear [-].

    Returns:
        Stress [Pa].
    """

    def energy(g):
        one = jnp.ones_like(g)
        F = ((one, g, 0.0), (0.0, one, 0.0), (0.0, 0.0, 1.0))
        return jnp.sum(strain_energy_density(material, F))

    return jax.grad(energy)(shear)


def lateral_stretch(
    material: AbstractHyperelastic, stretch: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Stretch across a bar at `stretch` with free sides [-].

    Args:
        material: The material.
        stretch: Length over that at rest [-].

    Returns:
        The stretch across [-].
    """
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


# Where an energy stops being one of a stable rubber


#: Logarithmic strains of the first two directions per logarithmic stretch.
MODES = {"uniaxial": (1.0, -0.5), "equibiaxial": (1.0, 1.0), "pure_shear": (1.0, 0.0)}
POINTS = 241
#: For each principal direction a change of shape that leaves its stretch, and one across, as
#: changes of the first two logarithmic strains.
_BASES = np.array([[[0, 1], [-2, 1]], [[1, 0], [1, -2]], [[1, -1], [1, 1]]]) / np.sqrt(
    [[[2], [6]]]
)


@dataclass(frozen=True)
class Stability:
    """Smallest and largest stretch [-] between which a material is stable, in `uniaxial`,
    `equibiaxial` and `pure_shear` tests.

    A bound equal to `limit` (or its reciprocal) is where the search ended.
    """

    uniaxial: tuple[float, float]
    equibiaxial: tuple[float, float]
    pure_shear: tuple[float, float]
    limit: float

    @property
    def unlimited(self) -> bool:
        """Whether no instability was found."""
        ranges = (self.uniaxial, self.equibiaxial, self.pure_shear)
        return all(low <= 1 / self.limit and high >= self.limit for low, high in ranges)

    def __str__(self) -> str:
        lines = [
            f"{name:<12s} stable for stretch {low:.3g} to {high:.3g}"
            for name, (low, high) in (
                ("uniaxial", self.uniaxial),
                ("equibiaxial", self.equibiaxial),
                ("pure shear", self.pure_shear),
            )
        ]
        return "\n".join([*lines, f"searched from {1 / self.limit:.3g} to {self.limit:.3g}"])


def drucker_stability(material: AbstractHyperelastic, *, limit: float = 10.0) -> Stability:
    """Stretches between which every further strain costs work, volume held.

    Drucker's criterion on Kirchhoff stress and logarithmic strain of an incompressible
    isotropic solid: the second derivative of the energy in any two logarithmic principal
    strains is positive definite. It is looked for along three tests; bounds are those of
    the search grid, 2 % apart for a limit of 10.

    Args:
        material: One number per leaf; take a region's own material.
        limit: Largest stretch to look at.

    Returns:
        Bounds of the stretch in each test.

    Raises:
        ValueError: If leaves hold one number per cell, or `limit` is not above 1.

    Reference: Drucker, J. Appl. Mech. 26, 1959.
    """
    _check.between("drucker_stability", "limit", limit, 1.0, 1e3, "", "Rubbers break at 10.")
    if any(np.ndim(leaf) for leaf in jax.tree.leaves(material)):
        raise ValueError(
            "drucker_stability: got one number per cell, need one per leaf. Check the "
            "material of each region by itself."
        )
    logs = np.linspace(-math.log(limit), math.log(limit), POINTS)
    strains = np.stack([np.outer(logs, mode) for mode in MODES.values()])
    stable = np.asarray(_is_stable(material, jnp.asarray(strains)))
    stretch = np.exp(logs)
    stretch[0], stretch[-1] = 1 / limit, limit
    ranges = [_run(stretch, flags) for flags in stable]
    return Stability(*ranges, limit)


@once
def _is_stable(material, strains: Float[Array, "modes points 2"]):
    def energy(log):
        a, b = jnp.exp(log)
        F = ((a, 0.0, 0.0), (0.0, b, 0.0), (0.0, 0.0, 1 / (a * b)))
        return material.isochoric_energy(F)

    def curvature(log, basis):
        """Second derivatives [J/m^3] along two changes of shape."""
        return jax.hessian(lambda z: energy(log + z @ basis))(jnp.zeros_like(log))

    def at(log):
        # along what leaves the stiffest direction as it is, its stiffness cannot drown the rest
        H = jax.vmap(curvature, (None, 0))(log, jnp.asarray(_BASES, log.dtype))
        H = H[jnp.argmax(jnp.abs(H[:, 1, 1]))]
        rounding = 16 * jnp.finfo(log.dtype).eps * jnp.abs(H[1, 1])
        return (H[1, 1] > 0) & (H[0, 0] - H[0, 1] ** 2 / H[1, 1] > -rounding)

    return jax.vmap(jax.vmap(at))(strains)


def _run(stretch: np.ndarray, stable: np.ndarray) -> tuple[float, float]:
    """The longest run of stable stretches around 1; (1, 1) if there is none."""
    middle = len(stretch) // 2
    if not stable[middle]:
        return 1.0, 1.0
    below = np.flatnonzero(~stable[:middle])
    above = np.flatnonzero(~stable[middle:])
    low = stretch[below[-1] + 1] if len(below) else stretch[0]
    high = stretch[middle + above[0] - 1] if len(above) else stretch[-1]
    return float(low), float(high)
