"""Hyperelastic coefficients from uniaxial tensile tests, of incompressible rubbers.

A curve is linear in its moduli; exponents and the locking measure are found around that
linear problem (variable projection).

Reference: Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Float

from sorojax import _check
from sorojax._display import displayed
from sorojax._explain import got
from sorojax._kinds import number_like
from sorojax._types import real
from sorojax.material import checks
from sorojax.material.homogeneous import Stability, drucker_stability
from sorojax.material.hyperelastic import AbstractHyperelastic, bulk_modulus
from sorojax.material.rubbers import (
    Gent,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    Yeoh,
    locking_stretch,
    made_of,
    shear_modulus,
)
from sorojax.material.softening.cycles import CYCLES, chosen

Columns = Callable[[np.ndarray, np.ndarray], np.ndarray]  # (stretch, nonlinear) -> columns
EXPONENTS = (0.7, 1.3, 2.0, 3.0, 5.0, 8.0)


def _neo_hookean(stretch, _):
    return (stretch - stretch**-2)[:, None]


def _mooney_rivlin(stretch, _):
    return 2 * (stretch - stretch**-2)[:, None] * np.stack([0 * stretch + 1, 1 / stretch], 1)


def _yeoh(stretch, _):
    x = stretch**2 + 2 / stretch - 3
    slope = 2 * (stretch - stretch**-2)
    return slope[:, None] * np.stack([np.ones_like(x), 2 * x, 3 * x**2], axis=1)


def _gent(stretch, locking):
    x = stretch**2 + 2 / stretch - 3
    return ((stretch - stretch**-2) / (1 - x / locking[0]))[:, None]


def _ogden(stretch, exponents):
    """Columns per mu_p alpha_p, which must not be negative."""
    l = stretch[:, None]
    return (l ** (exponents - 1) - l ** (-exponents / 2 - 1)) / exponents


@dataclass(frozen=True)
class Curve:
    """A fitted curve: linear `coefficients` [Pa] and `nonlinear` numbers [-] of a model."""

    columns: Columns
    coefficients: np.ndarray
    nonlinear: np.ndarray

    def __call__(self, stretch: np.ndarray) -> np.ndarray:
        """Engineering stress [Pa]."""
        return self.columns(stretch, self.nonlinear) @ self.coefficients


def fit_curve(
    model: type[AbstractHyperelastic],
    terms: int,
    stable: bool,
    stretch: np.ndarray,
    stress: np.ndarray,
    weight: np.ndarray,
) -> Curve:
    """The curve of `model` with the least weighted square error."""
    linear = {NeoHookean: _neo_hookean, MooneyRivlin: _mooney_rivlin, Yeoh: _yeoh}
    none = np.zeros(0)
    if model in linear:
        columns = linear[model]
        return Curve(columns, _solve(columns(stretch, none), stress, weight, stable), none)
    if model is Gent:
        largest = np.max(stretch**2 + 2 / stretch - 3)
        starts = [np.log([share]) for share in (0.02, 0.1, 0.5, 3.0)]
        return _project(
            _gent, starts, lambda v: largest * (1 + np.exp(v)), stretch, stress, weight
        )
    starts = [np.array(chosen) for chosen in combinations(EXPONENTS, terms)]
    return _project(
        _ogden, starts, lambda exponents: np.clip(exponents, 0.5, 20.0), stretch, stress, weight
    )


def _solve(columns, stress, weight, positive: bool) -> np.ndarray:
    root = np.sqrt(weight)
    scale = np.linalg.norm(root[:, None] * columns, axis=0)
    scaled, goal = root[:, None] * columns / scale, root * stress
    if positive:
        from scipy.optimize import nnls

        return nnls(scaled, goal)[0] / scale
    return np.linalg.lstsq(scaled, goal, rcond=None)[0] / scale


def _project(columns: Columns, starts, decode, stretch, stress, weight) -> Curve:
    """Nonlinear numbers from the best of several starts, coefficients never negative."""
    from scipy.optimize import least_squares

    root, size = np.sqrt(weight), np.linalg.norm(np.sqrt(weight) * stress)

    def curve(v):
        nonlinear = decode(v)
        return Curve(
            columns,
            _solve(columns(stretch, nonlinear), stress, weight, positive=True),
            nonlinear,
        )

    def error(v):
        return root * (curve(v)(stretch) - stress) / size

    ranked = sorted(starts, key=lambda v: np.linalg.norm(error(v)))[:4]
    found = [least_squares(error, v, x_scale="jac", max_nfev=200) for v in ranked]
    return curve(min(found, key=lambda f: f.cost).x)


def build(
    model: type[AbstractHyperelastic], curve: Curve, poisson_ratio: float, density: Any
) -> AbstractHyperelastic:
    """The compressible material with the fitted curve and the small-strain ratio."""
    coefficients = tuple(constants_of(model, curve))
    bulk = bulk_modulus(real(shear_modulus(model, coefficients)), poisson_ratio)
    return made_of(model, coefficients, bulk, density)


def covariance_of(
    model: type[AbstractHyperelastic],
    curve: Curve,
    stretch: np.ndarray,
    stress: np.ndarray,
    weight: np.ndarray,
) -> np.ndarray:
    """s^2 (J'W J)^-1 of the constants of the material that `build` makes of a curve, with J the
    slope of the stress by them and s^2 the weighted square error per degree of freedom."""
    constants = constants_of(model, curve)
    columns, h = [], 1e-30
    for k in range(len(constants)):  # by complex steps: exact to rounding
        moved = constants.astype(complex)
        moved[k] += 1j * h
        columns.append(np.imag(_stress(model, curve, moved, stretch)) / h)
    root = np.sqrt(weight)
    jacobian = root[:, None] * np.stack(columns, axis=1)
    freedom = int(np.sum(weight > 0)) - len(constants)
    if freedom <= 0:
        return np.full((len(constants),) * 2, np.nan)
    error = root * (curve(stretch) - stress)
    return error @ error / freedom * unit_covariance(jacobian)


def unit_covariance(jacobian: Float[np.ndarray, "points n"]) -> Float[np.ndarray, "n n"]:
    """(J'J)^-1, the covariance of numbers fitted to readings of unit noise; NaN where the
    readings do not tell them apart."""
    scale = np.linalg.norm(jacobian, axis=0)
    unknown = np.full((jacobian.shape[1],) * 2, np.nan)
    if not np.all(scale > 0):
        return unknown
    triangle = np.linalg.qr(jacobian / scale[None], mode="r")
    if np.linalg.cond(triangle) > 1e12:
        return unknown
    half = np.linalg.inv(triangle) / scale[:, None]
    return half @ half.T


def constants_of(model: type[AbstractHyperelastic], curve: Curve) -> np.ndarray:
    """Those of the material, in the order of its arguments."""
    c, further = curve.coefficients, curve.nonlinear
    if model is Ogden:
        order = np.argsort(further[c > 0])
        c, further = ((c / further)[c > 0][order], further[c > 0][order])
    return np.concatenate([c, further])


def _stress(model, curve: Curve, constants: np.ndarray, stretch: np.ndarray) -> np.ndarray:
    """Engineering stress [Pa] of the incompressible bar with such constants."""
    count = len(constants) - len(curve.nonlinear)
    if model is Ogden:
        count = len(constants) // 2
    c, further = constants[:count], constants[count:]
    return curve.columns(stretch, further) @ (c * further if model is Ogden else c)


def modulus_at_rest(curve: Curve) -> float:
    """Fitted small-strain Young's modulus of the incompressible bar [Pa]."""
    h = 1e-5
    low, high = curve(np.array([1 - h, 1 + h]))
    return float(high - low) / (2 * h)


# Hyperelastic coefficients from uniaxial tensile tests


MODELS = (NeoHookean, MooneyRivlin, Yeoh, Gent, Ogden)
_SOFTEST = 100.0  # Pa: the largest stress in a test of the softest gels
FEWEST = {NeoHookean: 1, MooneyRivlin: 2, Yeoh: 3, Gent: 2}  # numbers per model


@displayed
@dataclass(frozen=True)
class TensileFit:
    """A fitted `material` with the range that it is good for.

    `rms` is the root-mean-square error of engineering stress [Pa], `relative_rms` its ratio to
    the root-mean-square stress, `strain_range` the fitted strains, `spread` the scatter between
    `num_repeats` repeats where all have data (root-mean-square standard deviation over
    root-mean-square mean, NaN for one repeat), and `stable_stretch` the uniaxial stretch at
    which the fitted stiffness turns negative (infinite if it never does below a stretch of 20).
    `stability` has Drucker's criterion in three tests. `covariance` is that of the fitted
    constants, in the order of the material's arguments, moduli in Pa: s^2 (J'J)^-1 of least
    squares, with s^2 the square error per degree of freedom, as if no constant were at a bound;
    NaN where the points do not tell it.
    """

    material: Any
    rms: float
    strain_range: tuple[float, float]
    stable_stretch: float
    relative_rms: float
    spread: float
    num_repeats: int
    stability: Stability
    covariance: Float[np.ndarray, "constants constants"]


def fit_tensile(
    strain: Float[np.ndarray, " points"] | Sequence[Any],
    stress: Float[np.ndarray, " points"] | Sequence[Any],
    *,
    model: type[AbstractHyperelastic] = Yeoh,
    terms: int = 2,
    stable: bool = False,
    weights: Float[np.ndarray, " points"] | Sequence[Any] | None = None,
    cycles: str = "all",
    poisson_ratio: float = 0.49,
    density: float | None = None,
) -> TensileFit:
    """Coefficients of a rubber by least squares on a tensile test.

    The bar is taken as incompressible, as rubber nearly is, and so are the errors of the
    record. At a `poisson_ratio` of 0.49 the bar of the returned material is softer, of
    silicones by 2 to 4 % at 100 % strain and 5 to 10 % at 200 %, at 0.4999 by less than 0.2 %
    (`python -m benchmarks validation tensile`). The engineering stress at the stretch l is,
    for `Yeoh`, sigma = 2 (l - l^-2) (c1 + 2 c2 x + 3 c3 x^2) with x = l^2 + 2/l - 3;
    `poisson_ratio` only sets the bulk modulus of the result. Repeats count equally whatever
    their number of points. `Ogden` and `Gent` always come out stable: mu_p alpha_p > 0 (terms
    that come out zero are dropped) and exponents from 0.5 to 20, because a tensile test
    cannot tell alpha from -alpha/2, which is far too stiff in equibiaxial tension.

    Args:
        strain: Engineering strain [-], 1.0 is 100 %; or one list per repeat.
        stress: Engineering stress [Pa], force over the area at rest; or one list per repeat.
        model: NeoHookean, MooneyRivlin, Yeoh, Gent or Ogden.
        terms: Terms of `Ogden`, 1 to 3; other models ignore it.
        stable: Allow no negative coefficient, so that the fit is stable everywhere.
        weights: Weight per point [-], shaped as `stress`; 1 everywhere by default.
        cycles: Which points of a cyclic test, in the order of time: "first", beyond all strains
            before, for the first loading; "last", of the last loading as far as the test had
            been, for a preconditioned rubber; "all" by default. `fit_cyclic` fits both.
        poisson_ratio: Poisson's ratio of the returned material at small strains [-], below 0.5.
        density: Mass per reference volume [kg/m^3]; unknown by default.

    Returns:
        The material with its errors and the strain that it was fitted to.

    Raises:
        ValueError: If there are too few points; if they look like MPa, kPa, percent or
            stretch; if they do not determine a material with a positive modulus; or if the fit
            is unstable within the measured deformation in tension, equibiaxial tension or
            pure shear.

    Example:
        >>> strain = np.array([0.5, 1.0, 2.0, 3.0])
        >>> stress = np.array([214.0, 437.0, 960.0, 1530.0]) * kPa
        >>> fit = material.fit_tensile(strain, stress)
        >>> print(f"c1 = {float(fit.material.c1) / kPa:.1f} kPa")
        c1 = 97.8 kPa

    Reference:
        Yeoh, Rubber Chem. Technol. 66, 1993; Ogden, Saccomandi and Sgura, Comput. Mech. 34,
        2004; Seber and Wild, Nonlinear Regression, 1989, for the covariance.
    """
    checks.poisson_ratio("fit_tensile", poisson_ratio)
    need = needed("fit_tensile", model, terms)
    if cycles not in CYCLES:
        raise ValueError(
            f"fit_tensile: `cycles` is {cycles!r}, need one of {CYCLES}. Take 'first' for a "
            "part that is new, 'last' for one that has been stretched before."
        )
    repeats = _repeats(strain, stress, weights, need, cycles)
    strains, stresses, weight = (np.concatenate(part) for part in zip(*repeats, strict=True))
    curve = fit_curve(model, terms, stable, 1 + strains, stresses, weight)
    modulus = modulus_at_rest(curve)
    if not modulus > 0:
        raise ValueError(
            f"fit_tensile: the fit gives a modulus of {modulus:.3g} Pa at rest, need a "
            "positive modulus at rest. Add points at small strain, or pass stable=True."
        )
    material = build(model, curve, poisson_ratio, density)
    rms = float(np.sqrt(np.mean((curve(1 + strains) - stresses) ** 2)))
    fit = TensileFit(
        material=material,
        rms=rms,
        strain_range=(float(strains.min()), float(strains.max())),
        stable_stretch=_stable_stretch(curve, material),
        relative_rms=rms / float(np.sqrt(np.mean(stresses**2))),
        spread=_spread(repeats),
        num_repeats=len(repeats),
        stability=drucker_stability(material, limit=max(3.0, 1.2 * float(1 + strains.max()))),
        covariance=covariance_of(model, curve, 1 + strains, stresses, weight),
    )
    _check_stable(fit)
    return fit


def needed(where: str, model, terms: int) -> int:
    """Numbers that `model` has to be fitted."""
    if model not in MODELS:
        name = getattr(model, "__name__", repr(model))
        raise ValueError(
            f"{where}: `model` is {name}, need one of "
            f"{', '.join(m.__name__ for m in MODELS)}. Fit others with an optimiser on "
            "uniaxial_stress."
        )
    if model is Ogden and terms not in (1, 2, 3):
        raise ValueError(f"{where}: `terms` is {terms}, need 1, 2 or 3. Ogden takes 2.")
    return 2 * terms if model is Ogden else FEWEST[model]


def _repeats(strain, stress, weights, need: int, cycles: str) -> list[tuple[np.ndarray, ...]]:
    """(strain, stress, weight) of every repeat; the weights of each have mean 1 / points."""
    where = "fit_tensile"
    if len(strain) == 0 or len(stress) == 0:
        raise ValueError(
            f"{where}: got {len(strain)} strains and {len(stress)} stresses, need as many "
            "as the model has constants, or more. Give the points of the test."
        )
    several = np.ndim(strain[0]) > 0
    strains, stresses = (strain, stress) if several else ([strain], [stress])
    given = (
        (weights if several else [weights]) if weights is not None else [None] * len(strains)
    )
    if not len(strains) == len(stresses) == len(given):
        raise ValueError(
            f"{where}: got {len(strains)} strain, {len(stresses)} stress and {len(given)} "
            "weight lists, need one of each per repeat. Repeat by repeat, in one order."
        )
    parts = zip(strains, stresses, given, strict=True)
    return [_repeat(*part, need, len(strains), cycles) for part in parts]


def measured(where: str, strain, stress, need: int) -> tuple[np.ndarray, np.ndarray]:
    """Engineering strain [-] and stress [Pa] of a test, at least `need` points of each."""
    if not number_like(strain) or not number_like(stress):
        raise TypeError(
            f"{where}: got {got(strain)} and {got(stress)}, need numbers. Give strains [-] "
            "and stresses [Pa]."
        )
    strain, stress = np.asarray(strain, float), np.asarray(stress, float)
    if strain.shape != stress.shape or strain.ndim != 1 or len(strain) < need:
        raise ValueError(
            f"{where}: got strain {strain.shape} and stress {stress.shape}, need two "
            f"equal lists of at least {need} points: {need} numbers are fitted."
        )
    _check.finite(where, "strain, stress", np.stack([strain, stress]), "Drop NaN.")
    if np.any(strain <= -1) or np.max(np.abs(strain)) > 20:
        raise ValueError(
            f"{where}: strains {strain.min():g} to {strain.max():g} are not engineering "
            "strains of a tensile test; divide percent by 100."
        )
    _check_units(where, strain, stress)
    return strain, stress


def _repeat(
    strain, stress, weight, need: int, count: int, cycles: str
) -> tuple[np.ndarray, ...]:
    where = "fit_tensile"
    strain, stress = measured(where, strain, stress, need)
    weight = np.ones_like(strain) if weight is None else np.asarray(weight, float)
    if weight.shape != strain.shape or not np.all(weight >= 0) or not np.any(weight > 0):
        raise ValueError(
            f"{where}: got weights {weight.shape} for {len(strain)} points, need one per "
            "point, none negative. Leave `weights` out to weigh all points alike."
        )
    kept = chosen(strain, cycles)
    if kept is None or np.sum(kept & (weight > 0)) < need:
        raise ValueError(
            f"{where}: got {0 if kept is None else int(np.sum(kept))} points in the {cycles} "
            f"loading, need at least {need}: {need} numbers are fitted. List the points in "
            "the order of the test, and take cycles='all' for one without cycles."
        )
    strain, stress, weight = strain[kept], stress[kept], weight[kept]
    return strain, stress, weight / (np.mean(weight) * (len(strain) if count > 1 else 1))


def _check_units(where: str, strain: np.ndarray, stress: np.ndarray) -> None:
    """Refuse what looks like another quantity or unit."""
    largest = np.max(np.abs(stress))
    if largest < _SOFTEST:
        raise ValueError(
            f"{where}: the largest stress is {largest:.3g}, need Pa, in which no rubber "
            f"or gel stays below {_SOFTEST:g}. Multiply MPa by 1e6, kPa by 1e3."
        )
    at_rest = _strain_without_stress(strain, stress)
    if np.min(strain) > 0 and abs(at_rest - 1) < 0.2:
        raise ValueError(
            f"{where}: the stress vanishes at a strain of {at_rest:.3g}, need engineering "
            "strain, which is 0 there. Subtract 1 from stretch."
        )


def _strain_without_stress(strain: np.ndarray, stress: np.ndarray) -> float:
    """Where the curve has no stress: the root of a line through its end nearest to that."""
    order = np.argsort(strain)
    e, s = strain[order], stress[order]
    near = int(np.argmin(np.abs(s)))
    reach = 0.2 * (e[-1] - e[0])
    far = int(np.argmax(np.abs(e - e[near]) * (np.abs(e - e[near]) <= reach)))
    if far == near:
        far = near + 1 if near + 1 < len(e) else near - 1
    rise = s[far] - s[near]
    return float(e[near] - s[near] * (e[far] - e[near]) / rise) if rise else float("nan")


def _stable_stretch(curve: Curve, material) -> float:
    end = 20.0
    if isinstance(material, Gent):  # beyond the pole the formula is none
        end = min(end, 0.999 * float(locking_stretch(material)))
    stretch = np.linspace(1.0, end, 4000)
    falling = np.flatnonzero(np.diff(curve(stretch)) <= 0)
    return float(stretch[falling[0]]) if len(falling) else float("inf")


def _spread(repeats) -> float:
    if len(repeats) < 2:
        return float("nan")
    low = max(strain.min() for strain, *_ in repeats)
    high = min(strain.max() for strain, *_ in repeats)
    at = np.linspace(low, high, 101)
    curves = np.stack(
        [np.interp(at, *(v[np.argsort(e)] for v in (e, s))) for e, s, _ in repeats]
    )
    deviation = np.sqrt(np.mean(np.var(curves, axis=0, ddof=1)))
    return float(deviation / np.sqrt(np.mean(np.mean(curves, axis=0) ** 2)))


def _check_stable(fit: TensileFit) -> None:
    """Compare with the largest stretch of each test that has the measured I1."""
    measured = 1 + fit.strain_range[1]
    if measured <= 1:
        return
    first = measured**2 + 2 / measured
    grid = np.linspace(1.0, measured, 2001)
    same_biaxial = grid[np.searchsorted(2 * grid**2 + grid**-4, first) - 1]
    same_shear = grid[np.searchsorted(1 + grid**2 + grid**-2, first) - 1]
    tests = {
        "tension": (min(fit.stable_stretch, fit.stability.uniaxial[1] * 1.02), measured),
        "equibiaxial tension": (fit.stability.equibiaxial[1] * 1.02, same_biaxial),
        "pure shear": (fit.stability.pure_shear[1] * 1.02, same_shear),
    }
    for name, (reached, needed) in tests.items():
        if reached < needed:
            raise ValueError(
                f"fit_tensile: the fitted {type(fit.material).__name__} is unstable in {name} "
                f"from a stretch of {reached:.3g}, need {needed:.3g}, which the data "
                "cover. Pass stable=True, fit a smaller strain range, or another model."
            )
