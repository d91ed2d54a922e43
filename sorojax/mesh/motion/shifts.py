"""The linear steps of a motion between its searches for surfaces.

Outside `jit` NumPy takes them, also in derivatives: a program for each would be compiled for
longer than all of them run.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._jax.trace_state import is_traced
from sorojax.math.linear_map import OnHost, Parts, pushed


def _taken(motion: Any, staged: Parts, there: Parts, back: Parts, given, *found):
    """The results of a step, of the shapes `found`."""
    if is_traced(motion):
        return list(staged(*given))
    return pushed(given, OnHost(staged, there, back, given, found))


def placed(
    motion: Any, groups: Sequence[Any], points, shift
) -> list[Float[Array, "group dim"]]:
    """Where the nodes of each of the `groups` are after a shift."""

    def staged(points, shift):
        return [(points + shift)[at] for at in groups]

    def there(points, shift):
        return [(points + shift)[np.asarray(at)] for at in groups]

    def back(*changes):
        found = np.zeros(points.shape, points.dtype)
        for at, change in zip(groups, changes, strict=True):
            np.add.at(found, np.asarray(at), change)
        return found, found

    shapes = [(len(at), points.shape[1]) for at in groups]
    return _taken(motion, staged, there, back, (points, shift), *shapes)


def to_sharp(motion: Any, points, shift, sharp) -> Float[Array, "nodes dim"]:
    """What is left to go for the sharp nodes."""
    at = motion.border.sharp

    def staged(points, shift, sharp):
        return (_set(jnp.zeros_like(points), at, sharp - (points + shift)[at]),)

    def there(points, shift, sharp):
        return (_put(points, at, sharp - (points + shift)[at]),)

    def back(change):
        less = _put(change, at, -change[at])
        return less, less, change[at]

    return _taken(motion, staged, there, back, (points, shift, sharp), points.shape)[0]


def stepped(motion: Any, shift, step) -> Float[Array, "nodes dim"]:
    """A shift and one more, of which mid-side nodes are interpolated."""

    def staged(shift, step):
        return (shift + followed(motion, step),)

    def there(shift, step):
        return (shift + _followed(motion, step),)

    def back(change):
        return change, _followed_back(motion, change)

    return _taken(motion, staged, there, back, (shift, step), shift.shape)[0]


def on_boundary(motion: Any, points, sharp, landed) -> Float[Array, "nodes dim"]:
    """The shift of the boundary from where its nodes have landed."""
    groups = [own.nodes for own in motion.border.fields]
    if sharp is not None:
        groups, landed = [motion.border.sharp, *groups], (sharp, *landed)

    def staged(points, *landed):
        shift = jnp.zeros_like(points)
        for at, x in zip(groups, landed, strict=True):
            shift = _set(shift, at, x - points[at])
        return (shift,)

    def there(points, *landed):
        shift = np.zeros_like(points)
        for at, x in zip(map(np.asarray, groups), landed, strict=True):
            shift[at] = x - points[at]
        return (shift,)

    def back(change):
        ends = [change[np.asarray(at)] for at in groups]
        less = np.zeros_like(change)
        for at, x in zip(map(np.asarray, groups), ends, strict=True):
            less[at] = -x
        return less, *ends

    return _taken(motion, staged, there, back, (points, *landed), points.shape)[0]


def turned(motion: Any, shift) -> Float[Array, "components 1"]:
    """Components of a shift in the frames of the nodes, one after the other."""

    def staged(shift):
        return (jnp.einsum("nki,ni->nk", motion.frames, shift).reshape(-1, 1),)

    def there(shift):
        return (_in_frames(motion, shift),)

    def back(change):
        return (_from_frames(motion, change),)

    return _taken(motion, staged, there, back, (shift,), (shift.size, 1))[0]


def turned_back(motion: Any, components) -> Float[Array, "nodes dim"]:
    """The shift with such components, that of mid-side nodes interpolated."""
    shape = motion.frames.shape[:2]

    def staged(components):
        shift = jnp.einsum("nki,nk->ni", motion.frames, components.reshape(shape))
        return (followed(motion, shift),)

    def there(components):
        return (_followed(motion, _from_frames(motion, components)),)

    def back(change):
        return (_in_frames(motion, _followed_back(motion, change)),)

    return _taken(motion, staged, there, back, (components,), shape)[0]


def arrived(motion: Any, points, shift, boundary) -> Float[Array, "nodes dim"]:
    """Points after a shift of which that of mid-side nodes is interpolated, but those of the
    curved `boundary`."""
    bent = motion.bent

    def staged(points, shift, boundary):
        return (points + _set(followed(motion, shift), bent, boundary[bent]),)

    def there(points, shift, boundary):
        new = _followed(motion, shift)
        new[np.asarray(bent)] = boundary[np.asarray(bent)]
        return (points + new,)

    def back(change):
        at = np.asarray(bent)
        rest = change.copy()
        rest[at] = 0.0
        return change, _followed_back(motion, rest), _put(change, at, change[at])

    return _taken(motion, staged, there, back, (points, shift, boundary), points.shape)[0]


def followed(motion: Any, shift):
    """`shift` with that of all mid-side nodes interpolated from their cells."""
    if not len(motion.middles):
        return shift
    between = jnp.einsum("mk,mki->mi", motion.weights, shift[motion.parents])
    return _set(shift, motion.middles, between)


def _set(rows, at, new):
    """With new rows, each at a place of its own."""
    return rows.at[at].set(new, unique_indices=True)


def _followed(motion: Any, shift: np.ndarray) -> np.ndarray:
    shift = shift.copy()
    parents = np.asarray(motion.parents)
    between = np.einsum("mk,mki->mi", np.asarray(motion.weights), shift[parents])
    shift[np.asarray(motion.middles)] = between
    return shift


def _followed_back(motion: Any, change: np.ndarray) -> np.ndarray:
    change, middles = change.copy(), np.asarray(motion.middles)
    between = change[middles]
    change[middles] = 0.0
    shares = np.asarray(motion.weights)[:, :, None] * between[:, None]
    np.add.at(change, np.asarray(motion.parents), shares)
    return change


def _in_frames(motion: Any, shift: np.ndarray) -> np.ndarray:
    return np.einsum("nki,ni->nk", np.asarray(motion.frames), shift).reshape(-1, 1)


def _from_frames(motion: Any, components: np.ndarray) -> np.ndarray:
    frames = np.asarray(motion.frames)
    return np.einsum("nki,nk->ni", frames, components.reshape(frames.shape[:2]))


def _put(like: np.ndarray, at, rows: np.ndarray) -> np.ndarray:
    """Zeros but for some rows."""
    found = np.zeros_like(like)
    found[np.asarray(at)] = rows
    return found
