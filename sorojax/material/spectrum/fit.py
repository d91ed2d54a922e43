"""A relaxation spectrum from several tests together.

References:
    Lawson and Hanson, Solving Least Squares Problems, 1974, for the start.
    Schwarz, "Estimating the dimension of a model", Ann. Statist. 6, 1978, for the number of
    branches. Seber and Wild, Nonlinear Regression, 1989, for the covariance.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.jit import once
from sorojax.material.fit import unit_covariance
from sorojax.material.spectrum.records import AbstractViscoelasticTest
from sorojax.material.viscoelastic import Prony


@dataclass(frozen=True)
class SpectrumFit:
    """A fitted spectrum, and what is known of it.

    Attributes:
        modulus: Long-time modulus [Pa], of the kind of the tests; NaN where no test shows it.
        spectrum: Relaxation spectrum.
        covariance: Of the natural logarithms of modulus, shares and times, in this order,
            without the modulus where no test shows it: by the stated noise, or where none is
            stated by the scatter, s^2 (J'J)^-1; NaN where the readings do not tell it.
        criterion: Schwarz's criterion (BIC) by number of branches, up to a constant, up to two
            more than the best.
        relative_rms: Of each test, root mean square of log(predicted / measured).
        in_range: Of each time, whether the readings span it; others rest on the tail of a
            branch whose middle was not measured.
    """

    modulus: float
    spectrum: Prony
    covariance: Float[np.ndarray, "n n"]
    criterion: dict[int, float]
    relative_rms: tuple[float, ...]
    in_range: tuple[bool, ...]

    def __str__(self) -> str:
        percent = [f"+- {100 * x:.2g} %" for x in np.sqrt(np.diag(self.covariance))]
        first, count = len(percent) % 2, len(self.in_range)
        rows = [f"long-time modulus {self.modulus:.4g} Pa {percent[0]}"] if first else []
        pairs = zip(self.spectrum.shares, self.spectrum.times, strict=True)
        for k, (share, time) in enumerate(pairs, start=first):
            rows.append(
                f"share {float(share):.4g} {percent[k]}, time {float(time):.4g} s "
                f"{percent[k + count]}{'' if self.in_range[k - first] else ', not in range'}"
            )
        rms = ", ".join(f"{100 * x:.2g} %" for x in self.relative_rms)
        return "\n".join([*rows, f"relative rms by test {rms}"])


_PER_DECADE = 4  # times of the grid that a fit begins with
_FAINTEST, _CLOSEST = 1e-6, 1.02  # share and ratio of times that are no branch of its own
_PATIENCE = 2  # branches more than the best that are tried
_PRECISION = 1e-8  # relative, that no reading exceeds


def fit_spectrum(
    tests: Sequence[AbstractViscoelasticTest],
    *,
    branches: int | None = None,
    softest: float = 1e3,
) -> SpectrumFit:
    """Long-time modulus and relaxation spectrum nearest to several tests, fitted together.

    min of sum (log(predicted / measured) / noise)^2 over the logarithms of modulus, shares and
    times, so that all are positive. It begins with the best nonnegative spectrum on a fine grid
    of times, whose neighbours are merged. The number of branches has the least criterion of
    Schwarz, chi^2 + k log n with k numbers and n readings (n log(rms^2) in place of chi^2 where
    the noise is not stated): unlike those of prediction errors (AIC) it finds the number that
    made the readings, if they are many. At most one branch is tried for each decade of times,
    and one more, and one for four readings. Branches that the readings do not tell are left
    out, also where `branches` asks for more: a share below 1e-6, a time beside another, or a
    standard error above a factor e, as of a branch slower than the readings, which cannot be
    told from the modulus.

    Args:
        tests: Tests of one material, all with moduli of one kind.
        branches: Their number; by the criterion if omitted.
        softest: Moduli that are all below it [Pa] are taken for another unit.

    Returns:
        The spectrum with its errors.

    Raises:
        ValueError: If there are too few readings for the branches; if moduli look like kPa or
            MPa, or times like another unit; if tests contradict each other; if noise is stated
            for some tests only; or if nothing relaxes.

    Example:
        >>> storage, loss = [2.02e5, 2.71e5, 3.00e5], [15e3, 46e3, 6.3e3]
        >>> test = material.DynamicTest([0.1, 1.0, 10.0], storage, loss)
        >>> fit = material.fit_spectrum([test])
        >>> print(f"{fit.modulus / kPa:.0f} kPa, {float(fit.spectrum.times[0]):.2f} s")
        200 kPa, 0.25 s

    Reference:
        Tschoegl, The Phenomenological Theory of Linear Viscoelastic Behavior, 1989; Schwarz,
        Ann. Statist. 6, 1978; Seber and Wild, Nonlinear Regression, 1989, for the covariance.
    """
    data = _data(tuple(tests), softest)
    most = _most(data) if branches is None else branches
    _need_readings(data, most)
    found = _by_branches(data, most, patience=_PATIENCE if branches is None else most)
    if not found:
        raise ValueError(
            "fit_spectrum: got readings in which nothing relaxes, need a modulus that falls "
            "with time. Take the material without branches, or test faster and longer."
        )
    criterion = {count: _criterion(fit, data) for count, fit in found.items()}
    chosen = min(criterion, key=criterion.__getitem__) if branches is None else max(found)
    return _result(found[chosen], data, criterion)


class _Data(NamedTuple):
    """Tests, their noise (1 where it is unknown), and the times that they span."""

    tests: tuple[AbstractViscoelasticTest, ...]
    noise: Float[np.ndarray, " readings"]
    is_stated: bool
    times: tuple[float, float]

    @property
    def count(self) -> int:
        return sum(test.readings.size for test in self.tests)

    @property
    def has_modulus(self) -> bool:
        return any(test.has_modulus for test in self.tests)

    @property
    def levels(self) -> tuple[float, float]:
        """The least and the largest modulus of the readings; 1 and 2 if no test shows it."""
        moduli = np.concatenate([np.asarray(test.moduli) for test in self.tests])
        return (float(moduli.min()), float(moduli.max())) if moduli.size else (1.0, 2.0)

    @property
    def bounds(self) -> tuple[float, float]:
        """Of relaxation times: a decade more on both sides."""
        return self.times[0] / 10, self.times[1] * 10


class _Fit(NamedTuple):
    """Numbers (modulus, shares, times), errors over noise and their slopes by logarithms."""

    x: np.ndarray
    errors: np.ndarray
    slopes: np.ndarray

    @property
    def branches(self) -> int:
        return len(self.x) // 2


def _misfit(fit: _Fit) -> float:
    return float(fit.errors @ fit.errors)


def _data(tests: tuple[AbstractViscoelasticTest, ...], softest: float) -> _Data:
    if not tests:
        raise ValueError("fit_spectrum: got no test, need at least one. List the records.")
    stated = [test.noise is not None for test in tests]
    if any(stated) and not all(stated):
        raise ValueError(
            f"fit_spectrum: got noise for {sum(stated)} of {len(tests)} tests, need it for all "
            "or none. Estimate the others: without noise all readings count alike."
        )
    for test in tests:
        _check.float64("fit_spectrum", test.readings)
        _check_magnitudes(test, softest)
    _check_agreement(tests)
    noise = [
        np.broadcast_to(1.0 if test.noise is None else test.noise, test.readings.shape)
        for test in tests
    ]
    times = np.concatenate([np.asarray(test.timescales) for test in tests])
    times = times[times > 0]
    if not times.size:
        raise ValueError(
            "fit_spectrum: all readings are at time 0, need later ones. Add those after it."
        )
    return _Data(
        tests,
        np.concatenate([np.ravel(each) for each in noise]),
        all(stated),
        (float(times.min()), float(times.max())),
    )


def _check_magnitudes(test: AbstractViscoelasticTest, softest: float) -> None:
    kind, times = type(test).__name__, np.asarray(test.timescales)
    late = times[times > 0]
    if late.size and not (late.min() > 1e-9 and late.max() < 1e9):
        raise ValueError(
            f"fit_spectrum: {kind} tells of times from {late.min():.3g} to {late.max():.3g} s, "
            "need those of an experiment, 1e-9 to 1e9 s. Convert times to s, frequencies to Hz."
        )
    moduli = np.asarray(test.moduli)
    if moduli.size and moduli.max() < softest:
        raise ValueError(
            f"fit_spectrum: the largest modulus of {kind} is {moduli.max():.3g}, need Pa, in "
            f"which no rubber stays below {softest:g}. Multiply MPa by 1e6, kPa by 1e3; for a "
            "gel that soft pass a smaller `softest`."
        )


def _check_agreement(tests: tuple[AbstractViscoelasticTest, ...]) -> None:
    """Refuse moduli that are far larger in a slower test: one is in another unit. What a test
    tells at its time holds to a factor of some ten: G(t) and G'(1 / t) are not the same."""
    for slow in tests:
        for fast in tests:
            if not (slow.moduli.size and fast.moduli.size):
                continue
            later = np.asarray(slow.timescales)[:, None] >= np.asarray(fast.timescales)[None]
            ratio = np.asarray(slow.moduli)[:, None] / np.asarray(fast.moduli)[None]
            if np.any(later & (ratio > 30)):
                a, b = type(slow).__name__, type(fast).__name__
                raise ValueError(
                    f"fit_spectrum: {a} has {ratio[later].max():.3g} times the modulus of {b} "
                    "at the same or a shorter time, need tests that agree. One is in kPa or "
                    "MPa, its strain in percent, or its time not in s."
                )


def _most(data: _Data) -> int:
    decades = np.log10(data.times[1] / data.times[0])
    return max(1, min(int(np.ceil(decades)) + 1, data.count // 4))


def _need_readings(data: _Data, branches: int) -> None:
    need = 2 * branches + data.has_modulus
    if branches < 1:
        raise ValueError(
            f"fit_spectrum: `branches` is {branches}, need 1 or more. Leave it out for the "
            "number that the readings tell."
        )
    if data.count < need:
        raise ValueError(
            f"fit_spectrum: got {data.count} readings, need {need} for {branches} "
            f"branch{'es' * (branches > 1)}: each has a share and a time. Ask for fewer."
        )


def _by_branches(data: _Data, most: int, patience: int) -> dict[int, _Fit]:
    """The best fit of each number of branches that the readings tell, until so many in a row
    have been no better."""
    grid, program = _on_grid(data), _Program(data, most)
    found: dict[int, _Fit] = {}
    least, best = np.inf, most
    for count in range(1, most + 1):
        fits = [_polished(program, start) for start in _starts(data, grid, count)]
        fits = [fit for fit in fits if not _is_degenerate(fit, data)]
        if fits:
            found[count] = min(fits, key=_misfit)
            if _criterion(found[count], data) < least:
                least, best = _criterion(found[count], data), count
        if count >= best + patience:
            break
    return found


@once
def _ratios(tests, x: Float[Array, " n"]) -> tuple[Array, Array]:
    """Predicted over measured at (modulus, shares, times), and their slopes."""

    def ratios(x):
        count = x.shape[0] // 2
        spectrum = Prony(tuple(x[1 : count + 1]), tuple(x[count + 1 :]))
        rows = [jnp.ravel(test.predicted(x[0], spectrum) / test.readings) for test in tests]
        return jnp.concatenate(rows)

    return ratios(x), jax.jacfwd(ratios)(x)


class _Program(NamedTuple):
    """Errors for any number of branches up to `most`, by one compiled program."""

    data: _Data
    most: int

    def __call__(self, x: np.ndarray, linear: bool = False) -> _Fit:
        """At (modulus, shares, times): the logarithm of predicted over measured, which has no
        bias where the noise is large, or what it is for small errors. The branches that `x`
        lacks have no share."""
        count = len(x) // 2
        idle = self.most - count
        rest = 10 * self.data.bounds[1] * 1.5 ** np.arange(idle)
        padded = np.concatenate([x[: count + 1], np.zeros(idle), x[count + 1 :], rest])
        ratios, slopes = map(np.asarray, _ratios(self.data.tests, jnp.asarray(padded)))
        own = np.r_[0 : count + 1, self.most + 1 : self.most + 1 + count]
        errors = ratios - 1 if linear else np.log(ratios)
        scale = self.data.noise if linear else self.data.noise * ratios
        return _Fit(x, errors / self.data.noise, slopes[:, own] * x[None] / scale[:, None])


class _Grid(NamedTuple):
    """A modulus, and shares of times on a grid, many of which are zero."""

    modulus: float
    shares: np.ndarray
    times: np.ndarray


def _on_grid(data: _Data) -> _Grid:
    """The best nonnegative moduli of times on a grid, by steps of Gauss and Newton: one is
    enough for relaxation and vibration, which are linear in the moduli."""
    low, high = data.times[0] / 2, data.times[1] * 2  # slower ones would be the modulus
    size = int(np.ceil(_PER_DECADE * np.log10(high / low))) + 1
    times, program = np.geomspace(low, high, size), _Program(data, size)
    moduli = data.levels[0] * np.append(1.0, np.full(size, 0.5 / size))

    def at(moduli):
        return program(np.concatenate([moduli[:1], moduli[1:] / moduli[0], times]), linear=True)

    fit = at(moduli)
    for _ in range(15):
        step = _nonnegative(fit, moduli, data.has_modulus) - moduli
        new = moduli
        for length in (1.0, 0.5, 0.25, 0.1, 0.03):
            trial = at(moduli + length * step)
            if _misfit(trial) < _misfit(fit):
                new = moduli + length * step
                break
        if new is moduli:
            break
        gained, moduli, fit = 1 - _misfit(trial) / _misfit(fit), new, trial
        if gained < 1e-6:
            break
    return _Grid(float(moduli[0]), moduli[1:] / moduli[0], times)


def _nonnegative(fit: _Fit, moduli: np.ndarray, has_modulus: bool) -> np.ndarray:
    """Least squares of the linearised errors over moduli that are not negative."""
    from scipy.optimize import nnls

    size = len(moduli) - 1
    shares = fit.slopes[:, 1 : size + 1]  # by logarithms; a share is a modulus over the first
    whole = fit.slopes[:, :1] - shares.sum(axis=1, keepdims=True)
    free = np.arange(size + 1) >= (not has_modulus)
    slopes = (np.concatenate([whole, shares], axis=1) / moduli[None])[:, free]
    scale = np.maximum(np.linalg.norm(slopes, axis=0), np.finfo(float).tiny)
    found = moduli.copy()
    goal = slopes @ moduli[free] - fit.errors
    found[free] = nnls(slopes / scale[None], goal, maxiter=50 * size)[0] / scale
    return np.maximum(found, 1e-12 * found.sum())  # a logarithm has no zero


def _starts(data: _Data, grid: _Grid, count: int) -> list[np.ndarray]:
    """First guesses of `count` branches: the grid with neighbours merged, even times."""
    even = np.geomspace(*data.times, count + 2)[1:-1]
    low, high = data.levels
    share = max(high / low - 1, 1e-3) / count
    starts = [np.concatenate([[low], np.full(count, share), even])]
    kept = grid.shares > _FAINTEST
    if kept.any():
        merged = _merged(grid.shares[kept], grid.times[kept], count)
        starts.append(np.concatenate([[grid.modulus], *merged]))
    return starts


def _merged(shares: np.ndarray, times: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Branches joined at their mean logarithm until `count` are left, those first that move
    the least (Ward); if there are fewer, the largest is split."""
    found = list(zip(np.log(times), shares, strict=True))
    while len(found) > count:
        cost = [
            a * b / (a + b) * (late - early) ** 2
            for (early, a), (late, b) in itertools.pairwise(found)
        ]
        k = int(np.argmin(cost))
        (early, a), (late, b) = found[k : k + 2]
        found[k : k + 2] = [((a * early + b * late) / (a + b), a + b)]
    while len(found) < count:
        log, share = found.pop(int(np.argmax([share for _, share in found])))
        found = sorted([*found, (log - 0.7, share / 2), (log + 0.7, share / 2)])
    logs, joined = np.array(found).T
    return joined, np.exp(logs)


def _polished(program: _Program, start: np.ndarray) -> _Fit:
    """The least squares nearest to `start`, over logarithms within bounds."""
    from scipy.optimize import least_squares

    data, count = program.data, len(start) // 2
    low = np.log(
        np.r_[start[0] * 1e-6, np.full(count, _FAINTEST / 10), [data.bounds[0]] * count]
    )
    high = np.log(np.r_[start[0] * 1e6, np.full(count, 1e6), [data.bounds[1]] * count])
    free = np.arange(len(start)) >= (not data.has_modulus)
    last: dict[bytes, _Fit] = {}

    def at(logs) -> _Fit:
        if logs.tobytes() not in last:
            last.clear()
            x = start.copy()
            x[free] = np.exp(logs)
            last[logs.tobytes()] = program(x)
        return last[logs.tobytes()]

    inside = 1e-3 * np.ones(free.sum())
    found = least_squares(
        lambda logs: at(logs).errors,
        np.clip(np.log(start)[free], low[free] + inside, high[free] - inside),
        jac=lambda logs: at(logs).slopes[:, free],  # type: ignore[arg-type]
        bounds=(low[free], high[free]),
        x_scale="jac", ftol=1e-14, xtol=1e-14, gtol=1e-14, max_nfev=300,
    )  # fmt: skip
    fit = at(found.x)
    order = np.argsort(fit.x[count + 1 :])
    own = np.r_[0, 1 + order, 1 + count + order]
    return _Fit(fit.x[own], fit.errors, fit.slopes[:, own])


def _is_degenerate(fit: _Fit, data: _Data) -> bool:
    """Whether a branch is none of its own: without a share, beside another, or not told by the
    readings, as one that is slower than all of them and stands in for the modulus."""
    shares, times = fit.x[1 : fit.branches + 1], fit.x[fit.branches + 1 :]
    if np.any(shares < _FAINTEST) or np.any(times[1:] < _CLOSEST * times[:-1]):
        return True
    variance = np.diag(_covariance(fit, data))
    return bool(np.any(variance > 1))  # of logarithms: a factor e; NaN is not


def _criterion(fit: _Fit, data: _Data) -> float:
    n, numbers = data.count, 2 * fit.branches + data.has_modulus
    if data.is_stated:
        return _misfit(fit) + numbers * float(np.log(n))
    return float(n * np.log(max(_misfit(fit) / n, _PRECISION**2)) + numbers * np.log(n))


def _result(fit: _Fit, data: _Data, criterion: dict[int, float]) -> SpectrumFit:
    count = fit.branches
    shares, times = fit.x[1 : count + 1], fit.x[count + 1 :]
    low, high = data.times
    ends = np.cumsum([test.readings.size for test in data.tests])[:-1]
    relative = np.split(fit.errors * data.noise, ends)
    return SpectrumFit(
        modulus=float(fit.x[0]) if data.has_modulus else float("nan"),
        spectrum=Prony(tuple(shares.tolist()), tuple(times.tolist())),
        covariance=_covariance(fit, data),
        criterion=criterion,
        relative_rms=tuple(float(np.sqrt(np.mean(part**2))) for part in relative),
        in_range=tuple(bool(low <= time <= high) for time in times),
    )


def _covariance(fit: _Fit, data: _Data) -> np.ndarray:
    """Of the logarithms of what is fitted; NaN where it is unknown."""
    slopes, errors = fit.slopes[:, int(not data.has_modulus) :], fit.errors
    freedom = len(errors) - slopes.shape[1]
    if freedom < 0 or (freedom == 0 and not data.is_stated):
        return np.full((slopes.shape[1],) * 2, np.nan)
    return unit_covariance(slopes) * (1.0 if data.is_stated else errors @ errors / freedom)
