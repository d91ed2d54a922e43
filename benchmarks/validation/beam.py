"""A clamped Dragon Skin 10 beam, released from the horizontal: prediction of another load.

The records are motion capture of `srl-ethz/diffPD_sim2real` (MIT licence, Copyright 2021 Soft
Robotics Lab, ETH Zurich; arXiv:2201.12560): 100 Hz, three markers at the tip, two repeats with
0 and with 0.51 N at the tip. Young's modulus is fitted to the drop without load, a viscosity to
the damping ratio there; drop, frequency and damping ratio with a load are predicted.

`predict` takes any function from a tip load to a body and its damping, so another material
needs only another function beside `kelvin_voigt`.
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
from sorojax import fem, mesh
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


def fitted_modulus(drops: Float[np.ndarray, "3"], start: float = 265e3) -> float:
    """Young's modulus [Pa] of least squares over the drops without load, by Newton's steps."""

    def found(logarithm):
        problem = beam("plane stress", 0.0, jnp.exp(logarithm))
        return -fem.solve(problem).displacement[_tip(problem), 1] / mm

    logarithm = jnp.log(jnp.asarray(start))
    for _ in range(3):
        value, slope = jax.jvp(found, (logarithm,), (jnp.ones(()),))
        logarithm = logarithm + jnp.sum(slope * (drops - value)) / jnp.sum(slope**2)
    return float(jnp.exp(logarithm))


def fitted() -> tuple[float, float]:
    """Young's modulus [Pa] from the drop, viscosity [Pa s] from the damping ratio, both of
    the records without load."""
    repeats = measured(TIP_LOADS[0])
    young = fitted_modulus(np.mean([swing.drops for swing in repeats], axis=0))
    ratio = float(np.mean([swing.ratio for swing in repeats]))
    frequency = float(np.mean([swing.frequency for swing in repeats]))
    shear = young / (2 * (1 + POISSON_RATIO))
    viscosity = 2 * ratio / (2 * np.pi * frequency) * shear
    for _ in range(2):
        swing, *_ = predict(kelvin_voigt(young, viscosity), TIP_LOADS[0])
        viscosity *= ratio / swing.ratio
    return young, viscosity
