"""A tendon-driven silicone tentacle: a rod of physical parameters against motion capture.

The poses, the geometry and the places of the markers are those of section Va of the paper of
soromox (MIT licence). A rod of two tapered links hangs down; two tendons run along the first.

Fitted are one Young's modulus and density, the curvature at rest of the first link, friction of
the tendons in their channels and the tension lost before the channels, where tendons run, how
the base is mounted, and how far marker 2 has slipped between two recordings. That it has is
seen from what a fit without it leaves: beside the rod it is at one place in poses 1 to 6, and
11 mm away in poses 7 to 14. Normal distributions of the small corrections around what the
source says hold what the poses do not tell. There is no other force.
"""

import functools
import itertools
import json
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.discover import HERE
from sorojax import SE3, design, rod
from sorojax._progress import silent
from sorojax.design.calibration.calibration import Calibration
from sorojax.math.lie import homogeneous
from sorojax.units import mm

POSES = HERE / "recorded" / "tentacle_poses.json"
FIRST, SECOND = 305 * mm, 55 * mm  # lengths of the links
RADII = (15.41 * mm, 6.42 * mm, 4.80 * mm)  # at the base, where the links meet, at the tip
LENGTH = FIRST + SECOND
JOINT = FIRST / LENGTH
MARKERS = np.array([129.1, 219.5, 280.0, 360.0]) * mm / LENGTH
OFFSETS = np.array([[0, 0, 25], [0, 0, -21], [0, 0, 20], [8, 0, 0]]) * mm  # local frame
AXES = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # columns: local axes in the world
POISSON_RATIO, GRAVITY = 0.49, 9.81
SLIPPED = 1  # marker that moved between the two recordings
BEFORE = 6  # poses of the first recording
NOISE = 1 * mm  # of the motion capture
SCATTER = 4 * mm  # of every coordinate around the model, which is what weighs the readings

START = {
    "young_modulus": 400e3, "density": 1070.0, "rest_curvature": np.zeros((2, 2)),
    "friction": 0.1, "lost_tension": 0.1, "tilt": np.zeros(3), "base": np.zeros(3),
    "offset": np.full(2, 11.4 * mm), "end_offset": np.full(2, 2.4 * mm),
    "angle": np.array([30.0, 150.0]), "end_angle": np.array([30.0, 150.0]),
    "slip": np.zeros(3),
}  # fmt: skip
# Standard deviations around the nominal values; the modulus has none.
DEVIATIONS = {
    "density": 100.0, "rest_curvature": 1.0, "friction": 0.3, "lost_tension": 0.5,
    "tilt": 0.03, "base": 5 * mm, "offset": 1 * mm, "end_offset": 0.7 * mm, "angle": 4.0,
    "end_angle": 4.0, "slip": 10 * mm,
}  # fmt: skip
UNITS = {
    "young_modulus": "Pa", "density": "kg/m^3", "rest_curvature": "1/m", "friction": "-",
    "lost_tension": "N", "tilt": "rad", "base": "m", "offset": "m", "end_offset": "m",
    "angle": "degrees", "end_angle": "degrees", "slip": "m",
}  # fmt: skip
NOMINAL = START | {"friction": 0.0, "lost_tension": 0.0}
LOGARITHMIC = {name: name == "young_modulus" for name in START}
LOWER = {
    name: 0.0 if name in ("friction", "lost_tension", "young_modulus") else -np.inf
    for name in START
}

Parameters = dict[str, Array]


class Record(NamedTuple):
    """Poses that were measured.

    Attributes:
        tension: Of both tendons [N].
        markers: World frame [m].
        second: How likely a pose is of the second recording: 0 or 1, a half where unknown.
    """

    tension: Float[np.ndarray, "poses 2"]
    markers: Float[np.ndarray, "poses 4 3"]
    second: Float[np.ndarray, " poses"]

    def without_recording(self) -> "Record":
        return self._replace(second=np.full(len(self.tension), 0.5))


def read(file: Path = POSES) -> Record:
    """Poses of a file; `recording`, 1 or 2, is known of the shipped ones and may be given.

    Raises:
        ValueError: If a pose has not two tensions and four markers.
    """
    poses = json.loads(Path(file).read_text())["poses"]
    tension = np.array([pose["tension_N"] for pose in poses], float)
    markers = np.array([pose["markers_mm"] for pose in poses], float) * mm
    if tension.shape[1:] != (2,) or markers.shape[1:] != OFFSETS.shape:
        raise ValueError(
            f"validation: {file} has tensions of shape {tension.shape} and markers of shape "
            f"{markers.shape}, need (poses, 2) and (poses, 4, 3). Give `tension_N` and "
            "`markers_mm` of every pose."
        )
    if Path(file) == POSES:
        recording = [1] * BEFORE + [2] * (len(poses) - BEFORE)
    else:
        recording = [pose.get("recording", 1.5) for pose in poses]
    return Record(tension, markers, np.array(recording, float) - 1)


def body(p: Parameters, modes: tuple[int, int, int] = (5, 3, 2)) -> rod.Rod:
    """The rod, with `modes` polynomials per link of bending, stretch and twist."""
    bending, stretch, twist = modes
    basis = rod.piecewise(
        rod.legendre(kappa_x=twist, kappa_y=bending, kappa_z=bending, sigma_x=stretch), [JOINT]
    )

    def section(s):
        radius = np.interp(s, [0.0, JOINT, 1.0], RADII)
        return rod.circle(radius)

    def at_rest(s):
        s = jnp.asarray(s)
        share = jnp.where(s < JOINT, s / JOINT, 1.0)  # as at its end along the second link
        low, high = p["rest_curvature"]
        curved = low[None] + share[:, None] * (high - low)[None]
        zero = jnp.zeros_like(s)
        columns = [zero, curved[:, 0], curved[:, 1], zero + 1, zero, zero]
        return jnp.stack(columns, axis=1)

    return rod.rod(
        SE3(), basis, section, length=LENGTH, young_modulus=p["young_modulus"],
        poisson_ratio=POISSON_RATIO, density=p["density"], rest_strain=at_rest,
        nodes=20,
    )  # fmt: skip


def stored(p: Parameters, strain: Float[Array, "6"], s: Float[Array, ""]) -> Array:
    """Energy per length [J/m] of an incompressible neo-Hookean section in uniaxial stress.

    With W(l) = mu / 2 (l^2 + 2 / l - 3) of the stretch l along a fibre, to second order in the
    bending: A W(l) + I W''(l) (curvature change)^2 / 2; the tendons shorten the thin end by up
    to a fifth, where W'' is well above Young's modulus. Twist and shear are linear.
    """
    radius = jnp.interp(s, jnp.array([0.0, JOINT, 1.0]), jnp.array(RADII))
    area, second = jnp.pi * radius**2, jnp.pi / 4 * radius**4
    shear, stretch = p["young_modulus"] / 3, 1 + strain[3]
    along = shear / 2 * (stretch**2 + 2 / stretch - 3)
    slope = shear * (1 + 2 / stretch**3)
    across = 0.9 * area * (strain[4] ** 2 + strain[5] ** 2)
    bent = second * slope * (strain[1] ** 2 + strain[2] ** 2)
    return area * along + (bent + shear * (2 * second * strain[0] ** 2 + across)) / 2


def tendons(p: Parameters, tension: Float[Array, "2"]) -> rod.Tendons:
    """Both tendons; what is lost before the channels is lost by a tendon that pulls."""
    routes = []
    for k in range(2):
        first = p["offset"][k] * _along(p["angle"][k])
        end = p["end_offset"][k] * _along(p["end_angle"][k])
        routes.append(rod.Converging(first, first + (end - first) / JOINT, stop=JOINT))
    left = jnp.maximum(tension - p["lost_tension"], 0.0)
    return rod.Tendons(tuple(routes), left, friction=p["friction"])


def _along(degrees: Array) -> Float[Array, "2"]:
    angle = degrees * jnp.pi / 180
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def mounting(p: Parameters) -> Float[Array, "4 4"]:
    """Pose of the base in the world."""
    none = jnp.zeros(3)
    turned = SE3().exp(jnp.concatenate([p["tilt"], none]))[:3, :3] @ jnp.asarray(AXES)
    return homogeneous(turned, p["base"])


def resting(p: Parameters, tension: Float[Array, "2"]) -> tuple[rod.Rod, Array]:
    """The rod and its coordinates at equilibrium, in the frame of its base."""
    turned, model = mounting(p)[:3, :3], body(p)
    weight = rod.Gravity(turned.T @ jnp.array([0.0, 0.0, -GRAVITY]))
    silicone = rod.section_law(model, rod.EnergyLaw(functools.partial(stored, p)))
    return model, rod.equilibrium(model, (silicone, weight, tendons(p, tension))).q


def markers(
    p: Parameters, tension: Float[Array, "2"], second: Float[Array, ""]
) -> Float[Array, "4 3"]:
    """Where the markers are in the world [m]."""
    return markers_on(p, *resting(p, tension), second)


def markers_on(
    p: Parameters, model: rod.Rod, q: Array, second: Float[Array, ""]
) -> Float[Array, "4 3"]:
    """Where the markers are in the world [m] on a rod with coordinates `q`."""
    at = rod.points(rod.motion(model, q), MARKERS)
    arms = jnp.asarray(OFFSETS).at[SLIPPED].add(second * p["slip"])
    local = at.position + jnp.sum(at.directors * arms[:, None, :], axis=2)
    base = mounting(p)
    return local @ base[:3, :3].T + base[None, :3, 3]


@jax.jit
def predicted(
    p: Parameters, tension: Float[Array, "poses 2"], second: Float[Array, " poses"]
) -> Float[Array, "poses 4 3"]:
    """Markers of all poses [m], one after the other: equilibria differ in their steps."""
    return jax.lax.map(lambda pose: markers(p, *pose), (tension, second))


def parameters(values: dict | None = None) -> Parameters:
    """The first guess of the fit, or `values`, as arrays."""
    return {name: jnp.asarray(x, float) for name, x in (values or START).items()}


@functools.cache
def _model(file: Path):
    """What a fit asks for; made once, so that all fits share its programs."""
    record = read(file)
    tension, second = jnp.asarray(record.tension), jnp.asarray(record.second)

    @jax.jit
    def poses(p):
        return predicted(p, tension, second)

    @jax.jit
    def kept(p):
        return jnp.concatenate([jnp.ravel(p[name]) for name in DEVIATIONS])

    return record, poses, kept


def fit(
    left_out: tuple[int, ...] = (), start: Parameters | None = None, file: Path = POSES
) -> Calibration:
    """The parameters nearest to all poses but those `left_out`."""
    record, poses, kept = _model(file)
    measured = record.markers.copy()
    measured[list(left_out)] = np.nan
    sizes = {name: np.broadcast_to(d, np.shape(START[name])) for name, d in DEVIATIONS.items()}
    nominal = [np.ravel(NOMINAL[name]) for name in DEVIATIONS]
    experiments = (
        design.Experiment(poses, measured, SCATTER, name="markers"),
        design.Experiment(
            kept,
            np.concatenate(nominal),
            np.concatenate([np.ravel(size) for size in sizes.values()]),
            name="nominal values",
        ),
    )
    with silent():
        return design.calibrate(
            experiments, parameters() if start is None else start, lower=LOWER,
            logarithmic=LOGARITHMIC, steps=30 if start is None else 8, tolerance=1e-4,
        )  # fmt: skip


def errors(p: Parameters, record: Record) -> Float[np.ndarray, "poses 4"]:
    """Distances of the predicted markers from the measured ones [m]."""
    found = predicted(p, jnp.asarray(record.tension), jnp.asarray(record.second))
    return np.linalg.norm(np.asarray(found) - record.markers, axis=-1)


class LeftOut(NamedTuple):
    """Mean marker error of the poses that a fit has not seen [m], by pair, with their
    recording known and unknown."""

    pairs: list[tuple[int, int]]
    known: Float[np.ndarray, " pairs"]
    unknown: Float[np.ndarray, " pairs"]
    moduli: Float[np.ndarray, " pairs"]


def leave_pairs_out(start: Parameters, pairs=None) -> LeftOut:
    """A fit without each pair of poses (all 91 of 14 by default), judged by that pair."""
    record = read()
    blind = record.without_recording()
    pairs = list(
        itertools.combinations(range(len(record.tension)), 2) if pairs is None else pairs
    )
    known, unknown, moduli = [], [], []
    for pair in pairs:
        p = fit(pair, start).parameters
        known.append(errors(p, record)[list(pair)].mean())
        unknown.append(errors(p, blind)[list(pair)].mean())
        moduli.append(float(p["young_modulus"]))
    return LeftOut(pairs, np.array(known), np.array(unknown), np.array(moduli))
