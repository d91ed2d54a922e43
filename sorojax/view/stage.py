"""Scenes as pictures, and nouns as scenes: what `show` draws, to be put together anew."""

import importlib
from typing import Any

from sorojax.view.camera import View
from sorojax.view.picture import Panel, Picture
from sorojax.view.scene import Scene

#: Noun, module of this floor, function that makes its scene.
_SCENES = {
    "sorojax.sdf.base.AbstractSdf": ("shapes", "shape_scene"),
    "sorojax.sdf.isosurface.Surface": ("shapes", "surface_scene"),
    "sorojax.mesh.mesh.Mesh": ("meshes", "mesh_scene"),
    "sorojax.fem.problem.Problem": ("states", "problem_scene"),
    "sorojax.fem.solve.Solution": ("states", "solution_scene"),
    "sorojax.fem.solve_volume.CavitySolution": ("states", "solution_scene"),
    "sorojax.rod.rod.Rod": ("rods", "rod_scene"),
    "sorojax.rod.assembly.Assembly": ("rods", "rod_scene"),
}


def show_scene(scene: Scene, *, view: View = "iso", renderer: str = "auto") -> Picture:
    """One scene, in the plane with axes or shaded in space.

    Args:
        scene: From `scene_of`, or put together from `Surface`, `Lines`, `Arrows` and `Dots`.
        view: Camera of a solid scene.
        renderer: Of a solid scene.
    """
    if scene.dim == 2:
        from sorojax.view.plane import plane_figure

        figure, axes = plane_figure(scene)
        return Picture(figure, (Panel(axes),))
    from sorojax.view.solid import solid_figure

    figure, lens = solid_figure(scene, view=view, renderer=renderer)
    return Picture(figure, (Panel(figure.axes[0], lens),))


def scene_of(thing: Any, *at: Any, **options: Any) -> Scene:
    """A shape, surface, mesh, problem, solution, rod or assembly before it is drawn.

    Its `parts` may be joined with those of other scenes and shown as one.

    Args:
        thing: What is to be drawn.
        *at: Coordinates, of a rod or an assembly.
        **options: As of `show`, but `view` and `renderer`.

    Raises:
        TypeError: If `thing` has no scene.

    Example:
        `view.show(view.joined(view.scene_of(ball), view.scene_of(hand, q)), view="top")`
    """
    for kind in type(thing).__mro__:
        entry = _SCENES.get(f"{kind.__module__}.{kind.__qualname__}")
        if entry is not None:
            module = importlib.import_module(f"sorojax.view.{entry[0]}")
            return getattr(module, entry[1])(thing, *at, **options)
    names = ", ".join(sorted(name.rsplit(".", 1)[1] for name in _SCENES))
    raise TypeError(
        f"view.scene_of: got a {type(thing).__name__}, need one of {names}. Make a view.Scene "
        "of its parts."
    )
