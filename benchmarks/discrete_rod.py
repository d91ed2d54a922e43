"""A rod of short straight elements in NumPy and SciPy: an independent solution of free flights.

Nodes carry mass, elements turn; an element stretches and shears, neighbours bend and twist
against each other. Of second order in the length of an element; two meshes are extrapolated.

Reference:
    Gazzola, Dudte, McCormick, Mahadevan, R. Soc. Open Sci. 5, 2018, for the discretisation,
    here with one stiffness about all axes, for which moments need no transport.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp


class Bar(NamedTuple):
    """Length [m], stiffness in stretch and shear [N], in bending and torsion [N m^2], mass
    [kg/m] and rotary inertia per length [kg m], across the axis; twice that about it."""

    length: float
    axial: float
    bending: float
    mass: float
    rotary: float


Wrench = Callable[[float], tuple[np.ndarray, np.ndarray]]  # time -> moment, force on the base


def flight(
    bar: Bar, base: np.ndarray, axes: np.ndarray, wrench: Wrench, times: np.ndarray, count: int
) -> np.ndarray:
    """Places of both ends, (times, 2, 3), extrapolated from `count` and twice as many
    elements; at rest at the start, straight along the first of `axes`."""
    coarse, fine = (_ends(bar, base, axes, wrench, times, n) for n in (count, 2 * count))
    return (4 * fine - coarse) / 3


def _ends(bar, base, axes, wrench, times, count):
    h = bar.length / count
    along = np.linspace(0, bar.length, count + 1)
    x = base[None] + along[:, None] * axes[:, 0][None]
    turns = np.tile(_quaternion(axes), (count, 1))
    start = np.concatenate([x.ravel(), turns.ravel(), np.zeros(3 * (2 * count + 1))])
    mass = np.full(count + 1, bar.mass * h)
    mass[[0, -1]] /= 2
    sizes = np.cumsum([3 * (count + 1), 4 * count, 3 * (count + 1)])

    def rate(t, state):
        x, q, v, w = (part.reshape(count + (k in (0, 2)), -1) for k, part in
                      enumerate(np.split(state, sizes)))  # fmt: skip
        first = _first_axis(q)
        step = np.diff(x, axis=0)
        force = bar.axial * (step / h - first)
        moment = bar.bending / h * _turn_between(q)
        pulled, twisted = np.zeros_like(x), np.cross(step, force)
        pulled[:-1] += force
        pulled[1:] -= force
        twisted[:-1] += moment
        twisted[1:] -= moment
        torque, push = wrench(t)
        pulled[0] += push
        twisted[0] += torque
        return np.concatenate(
            [v.ravel(), _rate(q, w).ravel(), (pulled / mass[:, None]).ravel(),
             _spun(w, first, twisted / (bar.rotary * h)).ravel()]
        )  # fmt: skip

    found = solve_ivp(rate, (0, times[-1]), start, "DOP853", t_eval=times, rtol=1e-8, atol=1e-8)
    places = found.y[: sizes[0]].T.reshape(len(times), count + 1, 3)
    return places[:, [0, -1]]


def _quaternion(axes: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(axes).as_quat()
    return np.array([w, x, y, z])


def _product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    scalar = p[:, 0] * q[:, 0] - np.sum(p[:, 1:] * q[:, 1:], axis=1)
    vector = p[:, :1] * q[:, 1:] + q[:, :1] * p[:, 1:] + np.cross(p[:, 1:], q[:, 1:])
    return np.column_stack([scalar, vector])


def _first_axis(q: np.ndarray) -> np.ndarray:
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.column_stack([1 - 2 * (y**2 + z**2), 2 * (x * y + w * z), 2 * (x * z - w * y)])


def _turn_between(q: np.ndarray) -> np.ndarray:
    """Rotation vectors from each element to the next, in world axes."""
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    between = _product(q[1:], q[:-1] * np.array([1, -1, -1, -1]))
    between = between * np.sign(between[:, :1])
    sine = np.linalg.norm(between[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, between[:, :1])
    return between[:, 1:] * np.where(sine > 0, angle / np.where(sine > 0, sine, 1), 2)


def _rate(q: np.ndarray, w: np.ndarray) -> np.ndarray:
    return _product(np.column_stack([np.zeros(len(w)), w]), q) / 2


def _spun(w: np.ndarray, first: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Angular acceleration, of twice the inertia about the first axis: with a = `first`,
    d/dt (w + a (a . w)) = torque."""
    about = np.sum(first * w, axis=1, keepdims=True)
    right = torque - about * np.cross(w, first)
    return right - first * np.sum(first * right, axis=1, keepdims=True) / 2
