"""Constants of a softening rubber from cyclic tension.

The first loading, where the strain is larger than all before, gives the law; how far the
other points lie below it gives r, m and beta. The bar is incompressible: with W(l) the energy
of the fitted law at the stretch l and M that at the largest stretch before, the stress is
(1 - erf((M - W) / (m + beta M)) / r) dW/dl.

References:
    Ogden and Roxburgh, Proc. R. Soc. A 455, 1999. Murphy and Topel, "Estimation and inference
    in two-step econometric models", J. Bus. Econ. Stat. 3, 1985, for the covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed
from sorojax.material import checks
from sorojax.material.fit import TensileFit, fit_tensile, measured, needed
from sorojax.material.hyperelastic import AbstractHyperelastic
from sorojax.material.rubbers import Yeoh
from sorojax.material.softening.cycles import chosen, largest_before, turns
from sorojax.material.softening.law import Softening

_WHERE = "fit_cyclic"
_APART = 1.2  # between the energies of the largest and the smallest peak, to tell beta from m
_STARTS = [(q, m, b) for q in (0.3, 0.8) for m in (0.03, 0.3) for b in (0.02, 0.5)]


@displayed
@dataclass(frozen=True)
class CyclicFit:
    """A softening rubber, `material`, with the range that it is good for.

    `first` is the fit of the first loading. `rms` is the root-mean-square error of engineering
    stress [Pa] on the way back and when loaded again, `relative_rms` its ratio to the
    root-mean-square stress there; `num_cycles` counts unloadings. `covariance` is that of the
    constants of the first loading, in the order of the law's arguments, moduli in Pa, then
    r [-], m [J/m^3] and beta [-], as errors of all points are independent; rows of a beta that
    was given are zero. NaN where the points do not tell it.
    """

    material: Softening
    first: TensileFit
    rms: float
    relative_rms: float
    num_cycles: int
    covariance: Float[np.ndarray, "constants constants"]


def fit_cyclic(
    strain: Float[np.ndarray, " points"] | Sequence[Any],
    stress: Float[np.ndarray, " points"] | Sequence[Any],
    *,
    model: type[AbstractHyperelastic] = Yeoh,
    terms: int = 2,
    stable: bool = False,
    beta: float | None = None,
    poisson_ratio: float = 0.49,
    density: float | None = None,
) -> CyclicFit:
    """A softening rubber by least squares on a tensile test with cycles to growing stretch.

    Points where the strain is larger than all before are the first loading, which `model` is
    fitted to as in `fit_tensile`. The other points give r, m and beta. The rubber comes back to
    its length and is as stiff on the way back as when loaded again: a set that remains, or a
    loop within the cycles, shows in `rms`. Subtract a set from the strains, if it matters.

    Args:
        strain: Engineering strain [-] in the order of the test, 1.0 is 100 %.
        stress: Engineering stress [Pa], force over the area at rest.
        model: NeoHookean, MooneyRivlin, Yeoh, Gent or Ogden, of the first loading.
        terms: Terms of `Ogden`, 1 to 3; other models ignore it.
        stable: Allow no negative coefficient of the first loading.
        beta: The constant beta of `Softening` [-], fitted by default; give 0 where all cycles
            go to one stretch.
        poisson_ratio: Poisson's ratio of the returned material at small strains [-], below 0.5.
        density: Mass per reference volume [kg/m^3]; unknown by default.

    Returns:
        The material with its errors.

    Raises:
        ValueError: If there are too few points of the first loading or besides it; if they look
            like MPa, kPa, percent or stretch; if nothing softens; if all cycles go to one
            stretch and no beta is given; or if the law of the first loading is refused.

    Example:
        >>> yeoh = material.Yeoh(1e5, 5e3, 100.0, 1e7)
        >>> rubber = material.Softening(yeoh, r=2.0, m=1e4, beta=0.1)
        >>> up, down = np.linspace(0, 1, 20), np.linspace(1, 0, 20)
        >>> strain = np.concatenate([0.8 * up, 0.8 * down, 2 * up, 2 * down])
        >>> l = jnp.asarray(1 + strain)
        >>> F = jax.vmap(lambda l: jnp.diag(jnp.stack([l, l**-0.5, l**-0.5])))(l)
        >>> P = material.stress_history(rubber, None, F)
        >>> stress = P[:, 0, 0] - P[:, 1, 1] * l**-1.5
        >>> fit = material.fit_cyclic(strain, stress)
        >>> print(f"r = {fit.material.r:.3f}, m = {fit.material.m / 1e3:.3f} kJ/m^3")
        r = 2.000, m = 10.000 kJ/m^3

    Reference:
        Ogden and Roxburgh, Proc. R. Soc. A 455, 1999.
    """
    checks.poisson_ratio(_WHERE, poisson_ratio)
    if beta is not None:
        _check.not_negative(_WHERE, "beta", beta, "", "0 is the law of Ogden and Roxburgh.")
    need = needed(_WHERE, model, terms)
    strain, stress = measured(_WHERE, strain, stress, need + 3)
    kept = chosen(strain, "first")
    assert kept is not None
    _check_cycles(strain, kept, need, 2 if beta is not None else 3)
    first = fit_tensile(
        strain[kept],
        stress[kept],
        model=model,
        terms=terms,
        stable=stable,
        poisson_ratio=poisson_ratio,
        density=density,
    )
    points = _Points(1 + strain[~kept], 1 + largest_before(strain)[~kept], stress[~kept])
    found = _fitted(first.material, points, beta)
    error, to_first, to_found = _slopes(first, points, found)
    rms = float(np.sqrt(np.mean(error**2)))
    free = slice(None) if beta is None else slice(2)
    return CyclicFit(
        material=Softening(first.material, *found),
        first=first,
        rms=rms,
        relative_rms=rms / float(np.sqrt(np.mean(points.stress**2))),
        num_cycles=len(turns(strain)) // 2,
        covariance=_covariance(first.covariance, error, to_first, to_found, free),
    )


class _Points(eqx.Module):
    """Stretch, largest stretch before and engineering stress [Pa] below the first loading."""

    stretch: np.ndarray
    largest: np.ndarray
    stress: np.ndarray


def _check_cycles(strain, kept, need: int, more: int) -> None:
    if strain.min() < -0.05 * strain.max():
        raise ValueError(
            f"fit_cyclic: strains go down to {strain.min():.3g}, need a test in tension. Drop "
            "what is compressed."
        )
    if np.sum(kept) < need:
        raise ValueError(
            f"fit_cyclic: got {np.sum(kept)} points of the first loading, beyond all strains "
            f"before, need at least {need}: {need} numbers are fitted to it. List the points "
            "in the order of the test, from its start."
        )
    if np.sum(~kept) < more or len(turns(strain)) < 2:
        raise ValueError(
            f"fit_cyclic: got a first loading and {np.sum(~kept)} points besides, need an "
            f"unloading with at least {more}. Fit a first loading alone with fit_tensile."
        )


@jax.jit
def first_loading(law: AbstractHyperelastic, stretch: Float[Array, " points"]):
    """Energy [J/m^3] of an incompressible bar, and its slope, the engineering stress [Pa]."""

    def energy(l):
        side = l**-0.5
        return law.isochoric_energy(((l, 0.0, 0.0), (0.0, side, 0.0), (0.0, 0.0, side)))

    return jax.jvp(energy, (stretch,), (jnp.ones_like(stretch),))


def _fitted(law: AbstractHyperelastic, points: _Points, beta: float | None) -> np.ndarray:
    """r, m [J/m^3] and beta: the best of several searches, in shares of the largest peak."""
    from scipy.optimize import least_squares
    from scipy.special import erf

    (W, slope), (M, _) = (
        map(np.asarray, first_loading(law, jnp.asarray(x)))
        for x in (points.stretch, points.largest)
    )
    if beta is None and M.max() < _APART * M.min():
        raise ValueError(
            f"fit_cyclic: all cycles go to a stretch of about {points.largest.max():.3g}, need "
            "some that differ, to tell `beta` from `m`. Pass beta=0, or test to more stretches."
        )
    top, size = M.max(), np.linalg.norm(points.stress)

    def error(z):
        m, b = z[1], z[2] if beta is None else beta
        loss = z[0] * erf((M - W) / (m * top + b * M))
        return ((1 - loss) * slope - points.stress) / size

    count = 3 if beta is None else 2
    bounds = ([0.0, 1e-6, 0.0][:count], [1.0, 1e3, 1e3][:count])
    tight = {"bounds": bounds, "ftol": 1e-14, "xtol": 1e-14, "gtol": 1e-14}
    starts = sorted({start[:count] for start in _STARTS})
    q, m, *b = min((least_squares(error, z, **tight) for z in starts), key=lambda f: f.cost).x
    if not 1e-3 < q < 0.999:
        raise ValueError(
            f"fit_cyclic: the fit gives r = {1 / max(q, 1e-9):.3g}, need a softening from "
            "0.1 % to 99.9 %. Where the way back is that of the first loading, use "
            "fit_tensile; where a set remains, subtract it from the strains."
        )
    return np.array([1 / q, m * top, b[0] if b else beta])


def _slopes(first: TensileFit, points: _Points, found: np.ndarray):
    """Error of the stress [Pa], and its slopes by the constants of the first loading and by
    r, m and beta."""
    error, by_law, by_found = _error_and_slopes(first.material, jnp.asarray(found), points)
    constants = jax.tree.leaves(by_law)[: len(first.covariance)]
    return tuple(map(np.asarray, (error, jnp.stack(constants, axis=1), by_found)))


@jax.jit
def _error_and_slopes(law: AbstractHyperelastic, found: Float[Array, "3"], points: _Points):
    def error(law, found):
        W, slope = first_loading(law, jnp.asarray(points.stretch))
        M, _ = first_loading(law, jnp.asarray(points.largest))
        r, m, beta = found
        loss = jax.lax.erf((M - W) / (m + beta * M)) / r
        return (1 - loss) * slope - points.stress

    return error(law, found), *jax.jacfwd(error, (0, 1))(law, found)


def _covariance(first, error, to_first, to_found, free: slice) -> np.ndarray:
    """Of both steps: what is found in the second moves by `follow` with the first."""
    J = to_found[:, free]
    scale = np.linalg.norm(J, axis=0)
    count, freedom = len(first), len(error) - J.shape[1]
    whole = np.zeros((count + 3,) * 2)
    whole[:count, :count] = first
    rows = slice(count, count + J.shape[1])
    if freedom <= 0 or not np.all(scale > 0) or np.linalg.cond(J / scale) > 1e10:
        whole[rows] = whole[:, rows] = np.nan
        return whole
    inverse = np.linalg.pinv(J / scale) / scale[:, None]
    follow = -inverse @ to_first
    whole[rows, rows] = error @ error / freedom * (inverse @ inverse.T)
    whole[rows, rows] += follow @ first @ follow.T
    whole[rows, :count] = follow @ first
    whole[:count, rows] = whole[rows, :count].T
    return whole
