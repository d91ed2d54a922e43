"""Actors as an animated GLB file."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sorojax.io.animation import MovingSurface, export_animation
from sorojax.view import web
from sorojax.view.web_actor import Actor, actor, checked


def to_glb(
    path: str | os.PathLike,
    *things: Any,
    time: Float[Any, " frames"] | None = None,
    root: str | os.PathLike | None = None,
) -> Path:
    """Write what moves as a GLB file with animation.

    Morph targets carry changing shapes, node poses rigid motion. Colours of values stand
    still: they are those of the last frame.

    Args:
        path: File name, ending in .glb.
        *things: Actors, or what `actor` takes, as in `to_html`.
        time: Instants of the frames [s]; 25 frames per second if omitted.
        root: Folder that the file must lie in, links followed.

    Returns:
        The file written.
    """
    actors = [checked(t if isinstance(t, Actor) else actor(t)) for t in things]
    frames = web.num_frames("to_glb", actors)
    times = np.arange(frames) / 25 if time is None else np.asarray(time, float)
    limits = web.limits_of(actors)
    ramp = np.array(web.colours_of_map(), float) / 255
    shapes = []
    for each in actors:
        colours = np.array(web.rgb(each.colour))
        if each.values is not None:
            share = np.clip((each.values[-1] - limits[0]) / (limits[1] - limits[0]), 0, 1)
            colours = ramp[np.rint(share * (len(ramp) - 1)).astype(int)]
        shapes.append(
            MovingSurface(each.points, each.triangles, each.poses, colours, each.name)
        )
    export_animation(path, shapes, times, root=root)
    return Path(path) if root is None else Path(root) / path
