"""Static cases of the literature: elastica, roll-up, 45-degree bend, Princeton beam."""

from typing import Any

import numpy as np

from benchmarks.harness import Row, measure_calls, quick
from sorojax.math.lie import SE2, SE3
from sorojax.math.status import Status
from sorojax.rod import (
    Elastic,
    Section,
    TipWrench,
    chebyshev,
    circle,
    equilibrium,
    rod,
    tip_pose,
)
from sorojax.units import MPa, mm

FINGER: dict[str, Any] = {
    "length": 80 * mm,
    "young_modulus": 1 * MPa,
    "poisson_ratio": 0.3,
    "density": 2000.0,
}
BENDING = 1e6 * np.pi / 4 * 6e-3**4  # E I of the finger [N m^2]
EVERY = ("kappa_x", "kappa_y", "kappa_z", "sigma_x", "sigma_y", "sigma_z")
ELASTICA = {
    1: (0.943566763717, 0.301720773800),
    5: (0.612371639276, 0.713791523612),
    10: (0.445004402246, 0.810609024880),
}
SHEARABLE = {1: (0.942982087, -0.305043061), 10: (0.442215317, -0.829501238)}
# G J, then the load, then the tip; the beam has E = 1e7, radius 100
BEND = {
    (5e6 / 6, 300): (58.77912249, 22.24478095, 40.19189167),
    (5e6 / 6, 600): (47.15043857, 15.68480053, 53.47485879),
    (0.140577 * 5e6, 300): (58.53593262, 22.11261452, 40.48026158),
    (0.140577 * 5e6, 600): (46.89192478, 15.55778582, 53.60736927),
}
# load [N] and angle [deg], then the displacement along h and t [m]
PRINCETON = {
    (4.448, 30): (0.004399, 0.038938),
    (13.345, 0): (0.014873, 0.0),
    (13.345, 30): (0.015568, 0.115070),
    (13.345, 60): (0.010937, 0.178342),
    (13.345, 90): (0.0, 0.197016),
}


def every(modes):
    return chebyshev(**{name: modes for name in EVERY})


def planar(modes, **options):
    basis = chebyshev(kappa_z=modes)
    return rod(SE2(), basis, circle(6 * mm, shear_factor=27 / 28), **FINGER, **options)


def elastica(modes, alpha):
    """Tip over length under a dead force normal to the rod."""
    body = planar(modes)
    return at_rest(body, [0.0, 0.0, alpha * BENDING / 0.08**2]), 0.08


def shearable(modes, alpha):
    basis = chebyshev(kappa_z=modes, sigma_x=modes, sigma_y=modes)
    body = rod(SE2(), basis, circle(6 * mm, shear_factor=27 / 28), **FINGER)
    return at_rest(body, [0.0, 0.0, -alpha * BENDING / 0.08**2]), 0.08


def roll_up(modes, _):
    body = planar(modes, nodes=24)
    return at_rest(body, [2 * np.pi * BENDING / 0.08, 0.0, 0.0]), 0.08


def bend(modes, case):
    """An arc of 45 degrees, loaded out of its plane."""
    twisting, load = case
    section = Section(
        area=1.0,
        second_moment_y=1 / 12,
        second_moment_z=1 / 12,
        torsion_constant=twisting / 5e6,
        shear_factor=1.0,
    )
    body = rod(
        SE3(),
        every(modes),
        section,
        Elastic(1e7, 0.0, 1.0),
        length=100 * np.pi / 4,
        rest_strain=[0.0, 0.0, 0.01, 1.0, 0.0, 0.0],
        nodes=modes + 8,
    )
    return at_rest(body, [0.0] * 5 + [float(load)]), 1.0


def princeton(modes, case):
    """A blade along x, height along z, thickness along y."""
    load, angle = case[0], np.deg2rad(case[1])
    height, thick = 12.7e-3, 3.2024e-3
    section = Section(
        area=height * thick,
        second_moment_y=thick * height**3 / 12,
        second_moment_z=height * thick**3 / 12,
        torsion_constant=height * thick**3 / 3 * (1 - 0.63 * thick / height),
        shear_factor=5 / 6,
    )
    body = rod(
        SE3(),
        every(modes),
        section,
        Elastic(71.7e9, 0.31, 2700.0),
        length=0.508,
        nodes=modes + 8,
    )
    force = [0.0, load * np.sin(angle), load * np.cos(angle)]
    return at_rest(body, [0.0, 0.0, 0.0, *force]), 1.0


def at_rest(body, wrench):
    """Tip under a dead wrench, and the search."""
    wrench = TipWrench(wrench)
    return lambda: equilibrium(body, (wrench,)), lambda q: np.asarray(tip_pose(body, q))[
        :-1, -1
    ]


# name: the case, its references, modes to list, the last of which must meet the bar; in a
# quick run it alone, and for `TWO` the one before it
TWO = ("elastica 10",)
CASES = {
    "elastica 1": (elastica, {1: ELASTICA[1]}, (2, 3, 4, 5), 1e-8),
    "elastica 5": (elastica, {5: ELASTICA[5]}, (4, 5, 6, 7), 1e-8),
    "elastica 10": (elastica, {10: ELASTICA[10]}, (5, 6, 7, 8), 1e-8),
    "shearable finger": (shearable, SHEARABLE, (4, 6, 8), 1e-8),
    "roll-up": (roll_up, {0: (0.0, 0.0)}, (1, 3), 1e-9),
    "45-degree bend": (bend, BEND, (3, 4, 5, 6), 1e-6),
    "Princeton beam": (princeton, PRINCETON, (3, 4), 1e-6),
}


def rows():
    for name, (case, references, table, bar) in CASES.items():
        few = table[-2:] if name in TWO else table[-1:]
        for modes in few if quick(f"{name} with fewer modes than {few[0]}") else table:
            worst, ended, timing, count = 0.0, True, None, 0
            for key, expected in references.items():
                (search, tip), scale = case(modes, key)
                timing = timing or measure_calls(search, 5)
                rest = search()
                found = np.asarray(tip(rest.q)) / scale
                worst = max(worst, error(name, found, np.array(expected)))
                ended = ended and bool(rest.status == Status.successful)
                count = max(count, int(rest.iterations))
            assert timing is not None
            settings = {"case": name, "modes": modes, "iterations": count, "converged": ended}
            yield Row(
                "sorojax",
                settings,
                **timing.columns(),
                error=worst,
                reference=REFERENCE[name],
                bar=bar if modes == table[-1] else None,
                bar_on="error",
            )


def error(name, found, expected):
    if name == "Princeton beam":  # the reference lists displacements along h and t, 1e-6 m
        found = np.array([found[2], found[1]])
    size = np.linalg.norm(expected) if name == "45-degree bend" else 1.0
    return float(np.linalg.norm(found - expected) / size)


REFERENCE = {
    **dict.fromkeys(
        ("elastica 1", "elastica 5", "elastica 10"),
        "elliptic integrals, 12 digits; distance of the tips over length",
    ),
    "shearable finger": "shooting, 9 digits; distance of the tips over length",
    "roll-up": "the closed circle; distance of the tip from the clamp over length",
    "45-degree bend": "shooting, 10 digits; distance over distance from the origin",
    "Princeton beam": "shooting, 6 decimals; distance of the displacements [m]",
}
