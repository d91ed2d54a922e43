"""Relaxation spectra from what a laboratory has: relaxation, creep, vibration, ring-down.

Each test is a record that predicts its own readings from a modulus and a spectrum, and
`fit_spectrum` fits all of them together. A new kind of test is a class with the three hooks of
`AbstractViscoelasticTest`.

References:
    Tschoegl, The Phenomenological Theory of Linear Viscoelastic Behavior, 1989.
    Park and Schapery, "Methods of interconversion between linear viscoelastic material
    functions. Part I", Int. J. Solids Struct. 36, 1999, for creep.
    Lawson and Hanson, Solving Least Squares Problems, 1974, for the start. Schwarz, "Estimating
    the dimension of a model", Ann. Statist. 6, 1978, for the number of branches. Seber and
    Wild, Nonlinear Regression, 1989, for the covariance.
"""

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed
from sorojax._types import Numbers, optional_real, real
from sorojax.material.viscoelastic import (
    Prony,
    loss_modulus,
    relaxation_modulus,
    storage_modulus,
)


def creep_compliance(spectrum: Prony, t: Numbers) -> Float[Array, "..."]:
    """J(t) G_inf at the time `t` [s] after a step of stress: strain over that at the end [-].

    With K = diag(tau) + u u', u_i = sqrt(g_i tau_i), eigenvalues l_k (the retardation times) and
    eigenvectors v_k,

        J(t) G_inf = 1 - sum_k (v_k . u)^2 / l_k exp(-t / l_k).

    The error is below 1e-10 where the relaxation times span 8 decades.

    Args:
        spectrum: With one number for each share and time.
        t: Times [s].

    Returns:
        Like `t`.

    Reference:
        Park and Schapery, Int. J. Solids Struct. 36, 1999.
    """
    shares, times = jnp.stack(spectrum.shares), jnp.stack(spectrum.times)
    _check.shape(
        "creep_compliance", "shares", shares, (None,), "Take the spectrum of one material."
    )
    u = jnp.sqrt((shares + 1e-30) * times)  # a root has no slope at zero
    retardation, modes = jnp.linalg.eigh(jnp.diag(times) + u[:, None] * u[None])
    weights = (modes.T @ u) ** 2 / retardation
    t = real(t)
    return 1 - jnp.exp(-t[..., None] / retardation) @ weights


# The tests


class AbstractViscoelasticTest(eqx.Module):
    """Readings of one test of a material in its linear range.

    Moduli are all of one kind, shear or Young's: the branches of a nearly incompressible rubber
    relax both alike.

    Attributes:
        noise: Standard deviation of the readings over their values [-], a number or like
            `readings`; for one in their unit write `deviation / readings`. None is unknown.
    """

    noise: Float[Array, "..."] | None = eqx.field(
        converter=optional_real, default=None, kw_only=True
    )
    has_modulus: ClassVar[bool] = True  # and not only its shares

    @property
    @abc.abstractmethod
    def readings(self) -> Float[Array, "..."]:
        """What was measured, positive."""

    @property
    @abc.abstractmethod
    def timescales(self) -> Float[Array, "..."]:
        """Relaxation times [s] that the readings tell most of."""

    @abc.abstractmethod
    def predicted(self, modulus: Float[Array, ""], spectrum: Prony) -> Float[Array, "..."]:
        """The readings of a material with a long-time modulus [Pa] and a spectrum."""

    @property
    def moduli(self) -> Float[Array, "..."]:
        """Moduli [Pa] at `timescales`, as the readings have them."""
        return self.readings


class RelaxationTest(AbstractViscoelasticTest):
    """A strain is put on and held: E(t) = E_inf (1 + sum_i g_i exp(-t / tau_i)).

    Attributes:
        time: Since the strain was reached [s], increasing.
        modulus: Stress over strain [Pa].
    """

    time: Float[Array, " points"] = eqx.field(converter=real)
    modulus: Float[Array, " points"] = eqx.field(converter=real)

    def __check_init__(self):
        _check_history("RelaxationTest", self, "modulus", self.modulus, "Pa")

    @property
    def readings(self):
        return self.modulus

    @property
    def timescales(self):
        return self.time

    def predicted(self, modulus, spectrum):
        return modulus * relaxation_modulus(spectrum, self.time)


class CreepTest(AbstractViscoelasticTest):
    """A stress is put on and held: the strain grows as `creep_compliance` says.

    Attributes:
        time: Since the stress was reached [s], increasing.
        compliance: Strain over stress [1/Pa].
    """

    time: Float[Array, " points"] = eqx.field(converter=real)
    compliance: Float[Array, " points"] = eqx.field(converter=real)

    def __check_init__(self):
        _check_history("CreepTest", self, "compliance", self.compliance, "1/Pa")

    @property
    def readings(self):
        return self.compliance

    @property
    def timescales(self):
        return self.time

    @property
    def moduli(self):
        return 1 / self.compliance

    def predicted(self, modulus, spectrum):
        return creep_compliance(spectrum, self.time) / modulus


class DynamicTest(AbstractViscoelasticTest):
    """A vibration (DMA): stress in phase with the strain, and a quarter of a period ahead.

    Attributes:
        frequency: In Hz, not in rad/s.
        storage: E' [Pa].
        loss: E'' [Pa], `storage` times the loss factor.
    """

    frequency: Float[Array, " points"] = eqx.field(converter=real)
    storage: Float[Array, " points"] = eqx.field(converter=real)
    loss: Float[Array, " points"] = eqx.field(converter=real)

    def __check_init__(self):
        where = "DynamicTest"
        for name, unit in (("frequency", "Hz"), ("storage", "Pa"), ("loss", "Pa")):
            _check_row(where, name, getattr(self, name), self.frequency, unit)
        _check_noise(where, self)
        if not _check.is_concrete(self.storage) or not _check.is_concrete(self.loss):
            return
        if np.any(np.asarray(self.loss) < 1e-3 * np.asarray(self.storage)):
            raise ValueError(
                f"{where}: `loss` goes down to {float(np.min(self.loss)):.3g} Pa, need at "
                "least a thousandth of `storage`: no rubber loses less. Multiply a loss factor "
                "by the storage modulus; both are in Pa."
            )

    @property
    def readings(self):
        return jnp.stack([self.storage, self.loss])

    @property
    def timescales(self):
        return 1 / (2 * jnp.pi * self.frequency)

    @property
    def moduli(self):
        return self.storage

    def predicted(self, modulus, spectrum):
        omega = 2 * jnp.pi * self.frequency
        return modulus * jnp.stack(
            [storage_modulus(spectrum, omega), loss_modulus(spectrum, omega)]
        )


class RingDown(AbstractViscoelasticTest):
    """A body of one material that swings freely and comes to rest, a beam for instance.

    A mode of mass m and stiffness k E moves as exp(s t) with m s^2 + k E(s) = 0, where
    E(s) = E_inf (1 + sum_i g_i s tau_i / (1 + s tau_i)). With the measured s the angle of E is
    that of -s^2, 2 asin(zeta): for small losses the loss factor is 2 zeta. The modulus itself
    is not seen.

    Attributes:
        frequency: Of the swings, in Hz, not in rad/s.
        damping_ratio: zeta [-], logarithmic decrement over 2 pi for small ones.
    """

    frequency: Float[Array, " points"] = eqx.field(converter=real)
    damping_ratio: Float[Array, " points"] = eqx.field(converter=real)
    has_modulus: ClassVar[bool] = False

    def __check_init__(self):
        for name, unit in (("frequency", "Hz"), ("damping_ratio", "")):
            _check_row("RingDown", name, getattr(self, name), self.frequency, unit)
        _check_noise("RingDown", self)
        do = "A body that swings has less than 1: divide percent by 100."
        _check.between("RingDown", "damping_ratio", self.damping_ratio, 0, 1, "", do)

    @property
    def readings(self):
        return self.damping_ratio

    @property
    def timescales(self):
        return 1 / (2 * jnp.pi * self.frequency)

    @property
    def moduli(self):
        return self.readings[:0]

    def predicted(self, modulus, spectrum):
        omega, zeta = 2 * jnp.pi * self.frequency, self.damping_ratio
        s = omega * (1j - zeta / jnp.sqrt(1 - zeta**2))
        whole = jnp.ones_like(s)
        for g, tau in zip(spectrum.shares, spectrum.times, strict=True):
            whole = whole + g * (s * tau) / (1 + s * tau)
        return jnp.sin(jnp.arctan2(whole.imag, whole.real) / 2)


def predicted_readings(
    test: AbstractViscoelasticTest, modulus: Numbers, spectrum: Prony
) -> Float[Array, "..."]:
    """What `test` would have read of a material, like its `readings`.

    For a calibration of a spectrum together with other records, shapes and motions of a robot:
    it may be traced and has derivatives by all arguments.

    Args:
        test: The test.
        modulus: Long-time modulus [Pa], of the kind of the test.
        spectrum: Relaxation spectrum.

    Returns:
        An array like `test.readings`, in its unit.

    Raises:
        ValueError: If the spectrum differs from cell to cell.

    Example:
        >>> test = material.RelaxationTest([0.1, 1, 10], [3.2e5, 2.4e5, 2.0e5], noise=0.02)
        >>> def held(p):
        ...     spectrum = material.Prony(p["shares"], p["times"])
        ...     return material.predicted_readings(test, p["modulus"], spectrum)
        >>> record = design.Experiment(held, test.readings, test.noise * test.readings)
        >>> start = {"modulus": 1e5, "shares": jnp.array([1.0]), "times": jnp.array([0.5])}
        >>> found = design.calibrate([record], start).parameters  # with other records beside it
        >>> print(f"{found['modulus'] / kPa:.0f} kPa, {found['times'][0]:.2f} s")
        200 kPa, 0.93 s

    Reference:
        Tschoegl, The Phenomenological Theory of Linear Viscoelastic Behavior, 1989.
    """
    for name, terms in (("shares", spectrum.shares), ("times", spectrum.times)):
        for each in terms:
            _check.shape(
                "predicted_readings", name, each, (), "Take the spectrum of one material."
            )
    return test.predicted(real(modulus), spectrum)


def _check_history(where: str, test: Any, name: str, values: Any, unit: str) -> None:
    time = test.time
    _check_row(where, name, values, time, unit)
    _check.shape(where, "time", time, (None,), "Give a row of times [s].")
    _check_noise(where, test)
    _check.finite(where, "time", time, "Drop NaN.")
    _check.not_negative(where, "time", time, "s", "Time 0 is when the step is complete.")
    if _check.is_concrete(time) and np.any(np.diff(np.asarray(time)) <= 0):
        k = int(np.argmax(np.diff(np.asarray(time)) <= 0))
        raise ValueError(
            f"{where}: `time` {k + 1} is {float(time[k + 1]):g} s after {float(time[k]):g} s, "
            "need increasing times. Sort the readings, and make one test of each repeat."
        )


def _check_row(where: str, name: str, values: Any, beside: Any, unit: str) -> None:
    do = "A spectrum of positive shares has positive readings: drop those below the noise."
    _check.shape(where, name, values, (np.shape(beside) or (1,))[:1], "One for each reading.")
    _check.positive(where, name, values, unit, do)


def _check_noise(where: str, test: AbstractViscoelasticTest) -> None:
    if test.noise is None:
        return
    do = "Give standard deviations over readings."
    _check.positive(where, "noise", test.noise, "", do)
    try:
        np.broadcast_shapes(np.shape(test.noise), test.readings.shape)
    except ValueError:
        raise ValueError(
            f"{where}: `noise` has shape {np.shape(test.noise)}, need one that broadcasts to "
            f"{test.readings.shape}. Give a number, or one for each reading."
        ) from None


# The fit


@displayed
@dataclass(frozen=True)
class SpectrumFit:
    """A fitted spectrum, and what is known of it.

    Attributes:
        modulus: Long-time modulus [Pa], of the kind of the tests; NaN where no test shows it.
        spectrum: Relaxation spectrum.
        covariance: Of the natural logarithms of modulus, shares and times, in this order,
            without the modulus where no test shows it: by the stated noise, or where none is
            stated by the scatter, s^2 (J'J)^-1; NaN where the readings do not tell it.
        criterion: Schwarz's criterion (BIC) by number of branches, up to a constant.
        relative_rms: Of each test, root mean square of predicted over measured - 1.
        in_range: Of each time, whether the readings span it; others rest on the tail of a
            branch whose middle was not measured.
    """

    modulus: float
    spectrum: Prony
    covariance: Float[np.ndarray, "n n"]
    criterion: dict[int, float]
    relative_rms: tuple[float, ...]
    in_range: tuple[bool, ...]

    def _text(self) -> str:
        known = np.sqrt(np.diag(self.covariance))
        first = len(known) - 2 * len(self.in_range)
        rows = [f"SpectrumFit: long-time modulus {self.modulus:.4g} Pa"]
        rows[0] += f" +- {100 * known[0]:.2g} %" if first else ""
        pairs = zip(self.spectrum.shares, self.spectrum.times, self.in_range, strict=True)
        for k, (share, time, inside) in enumerate(pairs):
            errors = known[first + k], known[first + len(self.in_range) + k]
            rows.append(
                f"  share {float(share):.4g} +- {100 * errors[0]:.2g} %, time {float(time):.4g} "
                f"s +- {100 * errors[1]:.2g} %{'' if inside else ', outside the readings'}"
            )
        return "\n".join([*rows, f"  relative rms {[round(x, 5) for x in self.relative_rms]}"])


_PER_DECADE = 4  # times of the grid that a fit begins with
_FAINTEST, _CLOSEST = 1e-6, 1.02  # share and ratio of times that are no branch of its own
_PRECISION = 1e-8  # relative, that no reading exceeds


def fit_spectrum(
    tests: Sequence[AbstractViscoelasticTest],
    *,
    branches: int | None = None,
    softest: float = 1e3,
) -> SpectrumFit:
    """Long-time modulus and relaxation spectrum nearest to several tests, fitted together.

    min of sum ((predicted / measured - 1) / noise)^2 over the logarithms of modulus, shares and
    times, so that all are positive. It begins with the best nonnegative spectrum on a fine grid
    of times, whose neighbours are merged. The number of branches has the least criterion of
    Schwarz, chi^2 + k log n with k numbers and n readings (n log(rms^2) in place of chi^2 where
    the noise is not stated): unlike those of prediction errors (AIC) it finds the number that
    made the readings, if they are many. At most one branch is tried for each decade of times,
    and one more, and one for four readings; one that does not differ from its neighbour or has
    a share below 1e-6 is left out, also where `branches` asks for more.

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
        >>> f = np.array([0.1, 1.0, 10.0, 100.0])
        >>> test = material.DynamicTest(f, [2.11e5, 2.75e5, 3.0e5, 3.0e5], [27e3, 44e3, 6e3, 600])
        >>> fit = material.fit_spectrum([test], branches=1)
        >>> print(f"{fit.modulus / kPa:.0f} kPa, {float(fit.spectrum.times[0]):.2f} s")
        200 kPa, 0.25 s

    Reference:
        Tschoegl, The Phenomenological Theory of Linear Viscoelastic Behavior, 1989; Schwarz,
        Ann. Statist. 6, 1978; Seber and Wild, Nonlinear Regression, 1989, for the covariance.
    """
    data = _data(tuple(tests), softest)
    most = _most(data) if branches is None else branches
    _need_readings(data, most)
    grid = _on_grid(data)
    program = _Program(data, most)
    found: dict[int, _Fit] = {}
    for count in range(1, most + 1):
        fit = min((_polished(program, x) for x in _starts(data, grid, count)), key=_misfit)
        if _is_degenerate(fit, data):
            break
        found[count] = fit
    if not found:
        raise ValueError(
            "fit_spectrum: nothing relaxes in the readings, need a modulus that falls with time. "
            "Take the material without branches, or test faster and longer."
        )
    criterion = {count: _criterion(fit, data) for count, fit in found.items()}
    chosen = min(criterion, key=criterion.__getitem__) if branches is None else max(found)
    return _result(found[chosen], data, criterion)


class _Data(NamedTuple):
    """Tests, their noise (1 where it is unknown), and the times that they span."""

    tests: tuple[AbstractViscoelasticTest, ...]
    noise: tuple[Array, ...]
    is_stated: bool
    times: tuple[float, float]

    @property
    def count(self) -> int:
        return sum(test.readings.size for test in self.tests)

    @property
    def has_modulus(self) -> bool:
        return any(test.has_modulus for test in self.tests)

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
    noise = tuple(jnp.asarray(1.0 if t.noise is None else t.noise) for t in tests)
    times = np.concatenate([np.asarray(test.timescales) for test in tests])
    times = times[times > 0]
    if not times.size:
        raise ValueError(
            "fit_spectrum: all readings are at time 0, need later ones. Add those after it."
        )
    return _Data(tests, noise, all(stated), (float(times.min()), float(times.max())))


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
    """Refuse moduli that are far larger in a slower test: one is in another unit."""
    for slow in tests:
        for fast in tests:
            if not (slow.moduli.size and fast.moduli.size):
                continue
            later = np.asarray(slow.timescales)[:, None] >= np.asarray(fast.timescales)[None]
            ratio = np.asarray(slow.moduli)[:, None] / np.asarray(fast.moduli)[None]
            if np.any(later & (ratio > 100)):
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


@eqx.filter_jit
def _errors(tests, noise, x: Float[Array, " n"]) -> tuple[Array, Array]:
    """Errors over noise at (modulus, shares, times), and their slopes."""

    def errors(x):
        count = x.shape[0] // 2
        spectrum = Prony(tuple(x[1 : count + 1]), tuple(x[count + 1 :]))
        rows = [
            jnp.ravel((test.predicted(x[0], spectrum) / test.readings - 1) / deviation)
            for test, deviation in zip(tests, noise, strict=True)
        ]
        return jnp.concatenate(rows)

    return errors(x), jax.jacfwd(errors)(x)


class _Program(NamedTuple):
    """Errors for any number of branches up to `most`, by one compiled program."""

    data: _Data
    most: int

    def __call__(self, x: np.ndarray) -> _Fit:
        """At (modulus, shares, times); the branches that it lacks have no share."""
        count = len(x) // 2
        idle = self.most - count
        rest = 10 * self.data.bounds[1] * 1.5 ** np.arange(idle)
        padded = np.concatenate([x[: count + 1], np.zeros(idle), x[count + 1 :], rest])
        errors, slopes = _errors(self.data.tests, self.data.noise, jnp.asarray(padded))
        own = np.r_[0 : count + 1, self.most + 1 : self.most + 1 + count]
        return _Fit(x, np.asarray(errors), np.asarray(slopes)[:, own] * x[None])


def _on_grid(data: _Data) -> tuple[float, np.ndarray, np.ndarray]:
    """Modulus, and the shares of times on a grid, none negative: Gauss-Newton in the moduli,
    which relaxation and vibration are linear in, with the least squares of Lawson and Hanson."""
    from scipy.optimize import nnls

    low, high = data.bounds
    size = int(np.ceil(_PER_DECADE * np.log10(high / low))) + 1
    times, program = np.geomspace(low, high, size), _Program(data, size)
    level = [float(np.min(test.moduli)) for test in data.tests if test.moduli.size]
    moduli = np.append(min(level, default=1.0), np.full(size, 0.5 / size * min(level, default=1)))

    def at(moduli):
        return program(np.concatenate([moduli[:1], moduli[1:] / moduli[0], times]))

    fit = at(moduli)
    for _ in range(15):
        by_log = fit.slopes[:, 1 : size + 1]
        by_branch = by_log / moduli[None, 1:]
        whole = fit.slopes[:, :1] - by_log.sum(axis=1, keepdims=True)
        slopes = np.concatenate([whole / moduli[0], by_branch], axis=1)
        free = np.arange(size + 1) >= (not data.has_modulus)
        goal = slopes[:, free] @ moduli[free] - fit.errors
        scale = np.linalg.norm(slopes[:, free], axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        found = moduli.copy()
        found[free] = nnls(slopes[:, free] / scale[None], goal, maxiter=50 * size)[0] / scale
        found = np.maximum(found, 1e-12 * found.sum())
        for step in (1.0, 0.5, 0.25, 0.1, 0.03):
            trial = moduli + step * (found - moduli)
            new = at(trial)
            if _misfit(new) < _misfit(fit):
                break
        else:
            break
        gained = _misfit(fit) - _misfit(new)
        moduli, fit = trial, new
        if gained < 1e-6 * _misfit(fit):
            break
    return float(moduli[0]), moduli[1:] / moduli[0], times


def _starts(data: _Data, grid, count: int) -> list[np.ndarray]:
    """First guesses of `count` branches: the grid with neighbours merged, even times."""
    modulus, shares, times = grid
    kept = shares > 1e-6
    merged = _merged(shares[kept], times[kept], count) if kept.any() else None
    total = max(shares.sum(), 1e-3)
    even = np.geomspace(*data.times, count + 2)[1:-1]
    starts = [np.concatenate([[modulus], np.full(count, total / count), even])]
    if merged is not None:
        starts.insert(0, np.concatenate([[modulus], *merged]))
    return starts


def _merged(shares: np.ndarray, times: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Branches joined until `count` are left, those first that move the least (Ward), at their
    mean logarithm; if there are fewer, the largest is split."""
    shares, logs = list(shares), list(np.log(times))
    while len(shares) > count:
        a, b = np.array(shares[:-1]), np.array(shares[1:])
        k = int(np.argmin(a * b / (a + b) * np.diff(logs) ** 2))
        whole = a[k] + b[k]
        logs[k : k + 2] = [(a[k] * logs[k] + b[k] * logs[k + 1]) / whole]
        shares[k : k + 2] = [whole]
    while len(shares) < count:
        k = int(np.argmax(shares))
        logs[k : k + 1] = [logs[k] - 0.7, logs[k] + 0.7]
        shares[k : k + 1] = [shares[k] / 2] * 2
        order = np.argsort(logs)
        logs, shares = [logs[i] for i in order], [shares[i] for i in order]
    return np.array(shares), np.exp(logs)


def _polished(program: _Program, start: np.ndarray) -> _Fit:
    """The least squares nearest to `start`, over logarithms within bounds."""
    from scipy.optimize import least_squares

    data, count = program.data, len(start) // 2
    low = np.log(np.r_[start[0] * 1e-6, np.full(count, _FAINTEST / 10), [data.bounds[0]] * count])
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
        lambda logs: at(logs).slopes[:, free],
        bounds=(low[free], high[free]),
        x_scale="jac", ftol=1e-14, xtol=1e-14, gtol=1e-14, max_nfev=300,
    )  # fmt: skip
    fit = at(found.x)
    order = np.argsort(fit.x[count + 1 :])
    own = np.r_[0, 1 + order, 1 + count + order]
    return _Fit(fit.x[own], fit.errors, fit.slopes[:, own])


def _is_degenerate(fit: _Fit, data: _Data) -> bool:
    """Whether a branch is none of its own: without a share, or beside another."""
    shares, times = fit.x[1 : fit.branches + 1], fit.x[fit.branches + 1 :]
    return bool(np.any(shares < _FAINTEST) or np.any(times[1:] < _CLOSEST * times[:-1]))


def _criterion(fit: _Fit, data: _Data) -> float:
    n, numbers = data.count, 2 * fit.branches + data.has_modulus
    if data.is_stated:
        return _misfit(fit) + numbers * np.log(n)
    return n * np.log(max(_misfit(fit) / n, _PRECISION**2)) + numbers * np.log(n)


def _result(fit: _Fit, data: _Data, criterion: dict[int, float]) -> SpectrumFit:
    count, seen = fit.branches, data.has_modulus
    shares, times = fit.x[1 : count + 1], fit.x[count + 1 :]
    low, high = data.times
    ends = np.cumsum([test.readings.size for test in data.tests])[:-1]
    relative = zip(np.split(fit.errors, ends), data.tests, data.noise, strict=True)
    rms = [
        float(np.sqrt(np.mean((part.reshape(test.readings.shape) * np.asarray(noise)) ** 2)))
        for part, test, noise in relative
    ]
    return SpectrumFit(
        modulus=float(fit.x[0]) if seen else float("nan"),
        spectrum=Prony(tuple(shares.tolist()), tuple(times.tolist())),
        covariance=_covariance(fit.slopes[:, int(not seen) :], fit.errors, data.is_stated),
        criterion=criterion,
        relative_rms=tuple(rms),
        in_range=tuple(bool(low <= time <= high) for time in times),
    )


def _covariance(slopes: np.ndarray, errors: np.ndarray, is_stated: bool) -> np.ndarray:
    freedom = len(errors) - slopes.shape[1]
    scale = np.linalg.norm(slopes, axis=0)
    unknown = np.full((slopes.shape[1],) * 2, np.nan)
    if not np.all(scale > 0) or (freedom <= 0 and not is_stated):
        return unknown
    triangle = np.linalg.qr(slopes / scale[None], mode="r")
    if np.linalg.cond(triangle) > 1e12:
        return unknown
    half = np.linalg.inv(triangle) / scale[:, None]
    return half @ half.T * (1.0 if is_stated else errors @ errors / freedom)
