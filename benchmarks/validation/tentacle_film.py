"""Pictures of the tentacle: some poses in one, and a film through all of them."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.validation import tentacle
from sorojax import view
from sorojax.units import mm
from sorojax.view.film.film import Film

SHOWN = (0, 2, 5, 8, 11, 12)  # poses in the picture
MOVING, HELD = 7, 5  # frames from one pose to the next, and at each
FPS = 10.0
MARGIN = 5 * mm
MEASURED, PREDICTED, APART = "#c8102e", "#222222", "#c8553d"


class Posed:
    """The fitted tentacle under any tensions, by one compiled program."""

    def __init__(self, p: tentacle.Parameters):
        self.base = np.asarray(tentacle.mounting(p))
        self.model = tentacle.body(p)

        @jax.jit
        def at(tension, second):
            model, q = tentacle.resting(p, tension)
            return q, tentacle.markers_on(p, model, q, second)

        self._at = at

    def __call__(self, tension, second) -> tuple[list[Any], np.ndarray]:
        """Its surface in the world, and where the markers are predicted [m]."""
        q, found = self._at(jnp.asarray(tension), jnp.asarray(second))
        turn, place = self.base[:3, :3], self.base[None, :3, 3]
        parts = view.scene_of(self.model, q).parts
        surfaces = [part for part in parts if isinstance(part, view.Surface)]
        moved = [replace(part, points=part.points @ turn.T + place) for part in surfaces]
        return moved, np.asarray(found)


def _compared(found: np.ndarray, measured: np.ndarray) -> list[Any]:
    """Predicted and measured markers, and what is between them."""
    return [
        view.Lines(list(np.stack([found, measured], 1)), APART),
        view.Dots(found, PREDICTED, 4.0),
        view.Dots(measured, MEASURED, 4.0),
    ]


def scene(p: tentacle.Parameters, record: tentacle.Record, poses=SHOWN) -> view.Scene:
    """The rod in some poses with measured and predicted markers, in the world."""
    posed = Posed(p)
    parts: list[Any] = []
    for k in poses:
        surface, found = posed(record.tension[k], record.second[k])
        parts += [*surface, *_compared(found, record.markers[k])]
    return view.Scene(tuple(parts), title="Tentacle, " + str(len(poses)) + " poses")


def film(
    p: tentacle.Parameters, record: tentacle.Record, size: tuple[int, int] = (480, 560)
) -> Film:
    """Through all poses in their order: tensions move linearly from one to the next and are
    held there, where measured markers are shown beside the predicted ones. A pose begins every
    (HELD + MOVING) / FPS seconds."""
    posed, count = Posed(p), len(record.tension)
    share = np.concatenate([np.zeros(HELD), np.arange(1, MOVING + 1) / (MOVING + 1)])
    at = np.add.outer(np.arange(count), share).ravel()[:-MOVING]

    def scene_at(instant: int) -> view.Scene:
        pose, along = int(at[instant]), at[instant] % 1
        both = record.tension[[pose, min(pose + 1, count - 1)]]
        tension = (1 - along) * both[0] + along * both[1]
        surface, found = posed(tension, record.second[pose])
        beside = _compared(found, record.markers[pose])
        return view.Scene((*surface, *(beside if along == 0 else beside[1:2])))

    reach = np.concatenate([record.markers.reshape(-1, 3), posed.base[None, :3, 3]])
    box = reach.min(axis=0) - MARGIN, reach.max(axis=0) + MARGIN
    track = view.Track(np.arange(len(at)) / FPS, scene_at, extent=box)
    return view.animate(track, fps=FPS, size=size, title="Tentacle")
