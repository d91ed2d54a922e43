"""A clamped Dragon Skin 10 beam, released from the horizontal: prediction of another load.

The records are motion capture of `srl-ethz/diffPD_sim2real` (MIT licence, Copyright 2021 Soft
Robotics Lab, ETH Zurich; arXiv:2201.12560): 100 Hz, three markers at the tip, two repeats with
0 and with 0.51 N at the tip. Young's modulus is fitted to the drop without load, a viscosity to
the damping ratio there; drop, frequency and damping ratio with a load are predicted.

A second law has two Maxwell branches in place of the viscosity. Their times are chosen, on
either side of both frequencies; modulus and shares are fitted to drops and damping ratios of
both loads, so of that law both frequencies are predicted, and all of any other load.

`predict` takes any function from a tip load to a body and its damping, so another material
needs only another function beside `kelvin_voigt` and `viscoelastic`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from benchmarks.cases.fem_beam_data import HEIGHTS, POISSON_RATIO, TIP_LOADS
from benchmarks.cases.fem_release import LENGTH, beam, damped_cosine
from benchmarks.discover import HERE
from sorojax import fem, material, mesh, replace
from sorojax.units import mm

FOLDER = HERE / "recorded" / "dragon_skin_10_beam"
FILES = {
    TIP_LOADS[0]: ("beam_gravity_V2_a.csv", "beam_gravity_V2_b.csv"),
    TIP_LOADS[1]: ("beam_load52_V2_a.csv", "beam_load52_V2_b.csv"),
}
HELD = 5  # samples at the begin of a record that the beam is surely held
MOVED = 0.5  # mm below the held position: the beam is free
SETTLING, SWING = 0.1, 1.2  # s after the release between which the swing is read
REST = 0.5  # s at the end of a record
NEAR = {True: 8.0, False: 4.0}  # Hz, where the search begins without and with a load
BRANCHES = (12.0, 3.0)  # Hz, 1 / (2 pi) over the relaxation times
DURATION, STEP = 1.0, 2e-3  # s, of the simulated release


class Swing(NamedTuple):
    """What is read from a record, or predicted.

    Attributes:
        drops: Of the three markers, from held to rest [mm].
        frequency: Of the first mode, damped [Hz].
        ratio: Its damping ratio [-].
    """

    drops: Float[np.ndarray, "3"]
    frequency: float
    ratio: float


def read(file: Path) -> tuple[Float[np.ndarray, " time"], Float[np.ndarray, "time 3"]]:
    """Times [s] and heights of the three markers at the tip [mm]."""
    table = np.loadtxt(file, delimiter=",")
    return table[:, 0], table[:, [3, 6, 9]]


def measured(load: float) -> list[Swing]:
    """The repeats under one tip load [N]."""
    return [_swing(*read(FOLDER / name), load) for name in FILES[load]]


def released(time, heights) -> tuple[np.ndarray, np.ndarray]:
    """Times after the release [s], and the mean drop of the markers from where they were
    held [mm]."""
    drop = (heights[:HELD].mean(axis=0)[None] - heights).mean(axis=1)
    return time - time[np.argmax(drop > MOVED)], drop


def _swing(time, heights, load: float) -> Swing:
    rest = heights[time > time[-1] - REST].mean(axis=0)
    time, drop = released(time, heights)
    swings = (time > SETTLING) & (time < SWING)
    found = damped_cosine(time[swings], -drop[swings], NEAR[load == 0.0])
    return Swing(heights[:HELD].mean(axis=0) - rest, *found)


Body = Callable[[float], tuple[Any, Any]]


def kelvin_voigt(young_modulus: float, viscosity: float) -> Body:
    """A beam of one modulus [Pa] with a Kelvin-Voigt viscosity [Pa s], by its tip load [N]."""

    def body(load: float):
        return beam("plane stress", load, young_modulus), fem.KelvinVoigt(viscosity)

    return body


def viscoelastic(young_modulus: float, spectrum: material.Prony) -> Body:
    """A beam of one long-time modulus [Pa] that relaxes by `spectrum`, by its tip load [N]."""

    def body(load: float):
        problem = beam("plane stress", load, young_modulus)
        solid = material.Viscoelastic(problem.material, spectrum)
        return replace(problem, lambda p: p.material, solid), ()

    return body


def predict(body: Body, load: float) -> tuple[Swing, np.ndarray, np.ndarray]:
    """Drops, frequency and damping ratio of a beam with a tip load [N], then times [s] and
    height of the tip [mm] after the release."""
    problem, damping = body(load)
    drops = -fem.solve(problem).displacement[_tip(problem), 1] / mm
    motion = fem.simulate(problem, DURATION, STEP, damping=damping)
    time = np.asarray(motion.time)
    height = np.asarray(motion.displacements)[:, _tip(problem), 1].mean(axis=1) / mm
    late = time > SETTLING
    found = damped_cosine(time[late], height[late], NEAR[load == 0.0])
    return Swing(np.asarray(drops), *found), time, height


def _tip(problem) -> np.ndarray:
    """Nodes at the heights of the markers on the end of the beam."""
    return np.array([mesh.nearest_node(problem.mesh, (LENGTH, h * mm)) for h in HEIGHTS])


def fitted_modulus(drops: dict[float, Float[np.ndarray, "3"]], start: float = 265e3) -> float:
    """Young's modulus [Pa] of least squares over the drops by tip load, by Newton's steps."""

    def found(logarithm):
        rows = []
        for load in drops:
            problem = beam("plane stress", load, jnp.exp(logarithm))
            rows.append(-fem.solve(problem).displacement[_tip(problem), 1] / mm)
        return jnp.concatenate(rows)

    logarithm, wanted = jnp.log(jnp.asarray(start)), np.concatenate(list(drops.values()))
    for _ in range(3):
        value, slope = jax.jvp(found, (logarithm,), (jnp.ones(()),))
        logarithm = logarithm + jnp.sum(slope * (wanted - value)) / jnp.sum(slope**2)
    return float(jnp.exp(logarithm))


def fitted() -> tuple[float, float]:
    """Young's modulus [Pa] from the drop, viscosity [Pa s] from the damping ratio, both of
    the records without load."""
    drops, frequency, ratio = _mean(measured(TIP_LOADS[0]))
    young = fitted_modulus({TIP_LOADS[0]: drops})
    shear = young / (2 * (1 + POISSON_RATIO))
    viscosity = 2 * ratio / (2 * np.pi * frequency) * shear
    for _ in range(2):
        swing, *_ = predict(kelvin_voigt(young, viscosity), TIP_LOADS[0])
        viscosity *= ratio / swing.ratio
    return young, viscosity


def fitted_spectrum() -> tuple[float, material.Prony]:
    """Young's modulus [Pa] from the drops of both loads, and shares of branches of the times
    `BRANCHES` from their damping ratios.

    A mode of the complex frequency s = w (i - z / sqrt(1 - z^2)) has s^2 = -w0^2 E(s) / E_inf:
    the imaginary part of E(s) / s^2 vanishes, which is linear in the shares.
    """
    swings = {load: _mean(measured(load)) for load in TIP_LOADS}
    young = fitted_modulus({load: swing.drops for load, swing in swings.items()})
    wanted = np.array([swing.ratio for swing in swings.values()])
    first = _spectrum(np.array([swing.frequency for swing in swings.values()]), wanted)
    found = [predict(viscoelastic(young, first), load)[0] for load in TIP_LOADS]
    targets = wanted**2 / np.array([swing.ratio for swing in found])
    return young, _spectrum(np.array([swing.frequency for swing in found]), targets)


def _spectrum(frequencies, ratios) -> material.Prony:
    w, times = 2 * np.pi * frequencies, 1 / (2 * np.pi * np.array(BRANCHES))
    s = (w * (1j - ratios / np.sqrt(1 - ratios**2)))[:, None]
    shares = np.linalg.solve(
        (s * times / (1 + s * times) / s**2).imag, -(1 / s[:, 0] ** 2).imag
    )
    return material.Prony(list(shares), list(times))


def _mean(swings: list[Swing]) -> Swing:
    return Swing(*(np.mean(column, axis=0) for column in zip(*swings, strict=True)))
