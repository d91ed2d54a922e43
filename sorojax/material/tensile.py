"""Incompressible tensile curves of the rubbers and how each is fitted.

A curve is linear in its moduli; exponents and the locking measure are found around that
linear problem (variable projection).

Reference: Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from sorojax._types import real
from sorojax.material.hyperelastic import AbstractHyperelastic, bulk_modulus
from sorojax.material.ogden import Ogden
from sorojax.material.rubbers import Gent, MooneyRivlin, NeoHookean, Yeoh

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
    return _project(_ogden, starts, _within_range, stretch, stress, weight)


def _within_range(exponents):
    return np.clip(exponents, 0.5, 20.0)


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
    c = curve.coefficients
    if model is Ogden:
        kept = c > 0
        c, alpha = c[kept], curve.nonlinear[kept]
        order = np.argsort(alpha)
        shear = real(np.sum(c)) / 2
        moduli, exponents = tuple((c / alpha)[order]), tuple(alpha[order])
        return Ogden(moduli, exponents, bulk_modulus(shear, poisson_ratio), density)
    if model is Gent:
        bulk = bulk_modulus(c[0], poisson_ratio)
        return Gent(c[0], curve.nonlinear[0], bulk, density)
    if model is NeoHookean:
        return NeoHookean(c[0], bulk_modulus(c[0], poisson_ratio), density)
    if model is MooneyRivlin:
        return MooneyRivlin(*c, bulk_modulus(2 * (c[0] + c[1]), poisson_ratio), density)
    return Yeoh(*c, bulk_modulus(2 * c[0], poisson_ratio), density)


def modulus_at_rest(curve: Curve) -> float:
    """Fitted small-strain Young's modulus of the incompressible bar [Pa]."""
    h = 1e-5
    low, high = curve(np.array([1 - h, 1 + h]))
    return float(high - low) / (2 * h)
