"""Given forces and moments on rods, and their weight, as arrows and arcs."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sorojax import rod as R
from sorojax.view import style
from sorojax.view.marks import turning
from sorojax.view.quantity import short
from sorojax.view.scene import Arrows, Part

_ALONG = 9  # arrows of a force per length
_LENGTH, _RADIUS = 0.2, 0.07  # of the body: the longest arrow, an arc

Poses = Mapping[str, Float[np.ndarray, "stations h h"]]


def wrench_parts(
    poses: Poses, s: Float[np.ndarray, " stations"], forces: Sequence[Any], size: float
) -> list[Part]:
    """What `forces` hold of wrenches and gravity.

    Args:
        poses: Of the sections of every part, by name; "" where there is one rod.
        s: Where along a part they are, in [0, 1].
        forces: As given to the verbs of rods.
        size: Of the body [m]; arrows of one force share one scale, those of different
            forces do not compare.
    """
    parts: list[Part] = []
    for force in forces:
        name, inner = (force.part, force.force) if isinstance(force, R.On) else ("", force)
        if isinstance(inner, R.Gravity):
            chosen = (
                [np.asarray(poses[name])] if name else [np.asarray(p) for p in poses.values()]
            )
            parts += _weight(inner, chosen, size)
        elif isinstance(inner, R.TipWrench | R.PointWrench | R.LineWrench) and name in poses:
            parts += _wrench(inner, np.asarray(poses[name]), s, size)
    return parts


def _weight(gravity: R.Gravity, poses: list[np.ndarray], size: float) -> list[Part]:
    dim = poses[0].shape[1] - 1
    earth = np.zeros(dim)
    earth[-1] = -9.81
    value = earth if gravity.acceleration is None else np.asarray(gravity.acceleration)
    strength = float(np.linalg.norm(value))
    if not strength > 0:
        return []
    middle = np.mean([pose[:, :dim, dim].mean(axis=0) for pose in poses], axis=0)
    vector = value * (_LENGTH * size / strength)
    return [Arrows(middle[None], vector[None], style.GREY, f"gravity: {strength:.3g} m/s$^2$")]


def _wrench(force: Any, poses: np.ndarray, s: np.ndarray, size: float) -> list[Part]:
    """Arrows of the force and an arc of the moment, where they act."""
    dim = poses.shape[1] - 1
    spread = isinstance(force, R.LineWrench)
    at = np.linspace(0, 1, _ALONG) if spread else np.atleast_1d(float(getattr(force, "s", 1.0)))
    rows = _values(force.wrench, at)
    nearest = np.argmin(np.abs(at[:, None] - s[None]), axis=1)
    places = np.stack([np.interp(at, s, poses[:, k, dim]) for k in range(dim)], axis=1)
    moments, pulls = rows[:, :-dim], rows[:, -dim:]
    if getattr(force, "follower", False):
        turn = poses[nearest, :dim, :dim]
        pulls = np.einsum("sij,sj->si", turn, pulls)
        moments = np.einsum("sij,sj->si", turn, moments) if dim == 3 else moments
    per = "/m" if spread else ""
    parts: list[Part] = []
    strength = np.linalg.norm(pulls, axis=1)
    if (most := float(strength.max())) > 0:
        name = f"force: {short(most, 'N' + per)}"
        parts.append(Arrows(places, pulls * (_LENGTH * size / most), style.LOAD, name))
    strength = np.linalg.norm(moments, axis=1)
    if (most := float(strength.max())) > 0:
        name = f"moment: {short(most, 'N' if spread else 'N m')}"
        for k in np.flatnonzero(strength > 1e-9 * most):
            axis = moments[k] if dim == 3 else float(moments[k, 0])
            radius = _RADIUS * size * float(strength[k]) / most
            parts += turning(places[k], axis, radius, style.COLOURS[4], name)
    return parts


def _values(wrench: Any, at: np.ndarray) -> np.ndarray:
    """One row of components per place."""
    if callable(wrench):
        return np.asarray(jax.vmap(wrench)(jnp.asarray(at)))
    return np.broadcast_to(np.asarray(wrench), (len(at), *np.shape(wrench)))
