"""Tests of a viscoelastic material as records that predict their own readings.

A new kind of test is a class with the hooks of `AbstractViscoelasticTest`.

References:
    Tschoegl, The Phenomenological Theory of Linear Viscoelastic Behavior, 1989.
    Park and Schapery, "Methods of interconversion between linear viscoelastic material
    functions. Part I", Int. J. Solids Struct. 36, 1999, for creep.
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, optional_real, real
from sorojax.material.viscoelastic import (
    Prony,
    loss_modulus,
    relaxation_modulus,
    storage_modulus,
)


def creep_compliance(spectrum: Prony, t: Numbers) -> Float[Array, "..."]:
    """J(t) G_inf at the time `t` [s] after a step of stress: strain over that at the end [-].

    With K = diag(tau) + u u', u_i = sqrt(g_i tau_i), its eigenvalues l_k (the retardation
    times) and eigenvectors v_k,

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
    return 1 - jnp.exp(-jnp.multiply.outer(real(t), 1 / retardation)) @ weights


Noise = Float[Array, "..."] | None


class AbstractViscoelasticTest(eqx.Module):
    """Readings of one test of a material in its linear range.

    Moduli are all of one kind, shear or Young's: the branches of a nearly incompressible rubber
    relax both alike.

    `noise` of each is the standard deviation of the readings over their values [-], a number or
    like `readings`; for one in their unit write `deviation / readings`. None is unknown.
    """

    has_modulus: ClassVar[bool] = True  # and not only its shares

    @property
    @abc.abstractmethod
    def noise(self) -> Noise:
        """Standard deviation over the readings [-]."""

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
        modulus: Stress over strain [Pa]; a strain of 0.1 is 10 %.
        noise: Standard deviation over the readings [-]; None is unknown.
    """

    time: Float[Array, " points"] = eqx.field(converter=real)
    modulus: Float[Array, " points"] = eqx.field(converter=real)
    noise: Noise = eqx.field(converter=optional_real, default=None)

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
        compliance: Strain over stress [1/Pa]; a strain of 0.1 is 10 %.
        noise: Standard deviation over the readings [-]; None is unknown.
    """

    time: Float[Array, " points"] = eqx.field(converter=real)
    compliance: Float[Array, " points"] = eqx.field(converter=real)
    noise: Noise = eqx.field(converter=optional_real, default=None)

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
        noise: Standard deviation over the readings [-], (2, points) where storage and loss
            differ; None is unknown.
    """

    frequency: Float[Array, " points"] = eqx.field(converter=real)
    storage: Float[Array, " points"] = eqx.field(converter=real)
    loss: Float[Array, " points"] = eqx.field(converter=real)
    noise: Noise = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        where = "DynamicTest"
        for name, unit in (("frequency", "Hz"), ("storage", "Pa"), ("loss", "Pa")):
            _check_row(where, name, getattr(self, name), self.frequency, unit)
        _check_noise(where, self)
        if not _check.is_concrete(self.storage) or not _check.is_concrete(self.loss):
            return
        if np.all(np.asarray(self.loss) < 1e-3 * np.asarray(self.storage)):
            raise ValueError(
                f"{where}: got a `loss` of {float(np.max(self.loss)):.3g} Pa at most, need a "
                "thousandth of `storage` or more: no rubber loses less. Multiply a loss factor "
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
        noise: Standard deviation over the readings [-]; None is unknown.
    """

    frequency: Float[Array, " points"] = eqx.field(converter=real)
    damping_ratio: Float[Array, " points"] = eqx.field(converter=real)
    noise: Noise = eqx.field(converter=optional_real, default=None)
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
        decay = omega * zeta / jnp.sqrt(1 - zeta**2)
        stored, lost = jnp.ones_like(omega), jnp.zeros_like(omega)  # E(s) = stored + i lost
        for g, tau in zip(spectrum.shares, spectrum.times, strict=True):
            a, b = 1 - decay * tau, omega * tau  # 1 + s tau = a + i b
            size = a**2 + b**2
            stored, lost = stored + g * (1 - a / size), lost + g * b / size
        return jnp.sin(jnp.arctan2(lost, stored) / 2)


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
        200 kPa, 0.82 s

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
    if not _check.is_concrete(time):
        return
    wrong = np.flatnonzero(np.asarray(time)[1:] <= np.asarray(time)[:-1])
    if wrong.size:
        k = int(wrong[0])
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
