"""`show`: one verb that draws any noun; what draws it is loaded when it is first asked for."""

import functools
import importlib
import inspect
from collections.abc import Callable
from typing import Any

from sorojax import _explain
from sorojax.view.picture import Picture, show_scene
from sorojax.view.raster.scene import Scene

#: Functions of this floor, and the nouns that they draw: their classes are not imported.
_PICTURES = {
    "draw.shapes.show_shape": "sdf.base.AbstractSdf",
    "draw.shapes.show_surface": "sdf.surface.marching.Surface",
    "draw.shapes.show_curve": "sdf.surface.marching.Curve",
    "draw.shapes.show_part": "design.part.Part",
    "draw.meshes.show_quality": "mesh.quality.Quality",
    "draw.bodies.show_path": "fem.equilibrium.solve.Path fem.dynamics.trajectory.Trajectory",
    "draw.bodies.show_vibration": "fem.stability.modal.Modes",
    "draw.bodies.show_buckling": "fem.stability.buckling.CriticalLoads "
    "fem.stability.continuation.CriticalPoint",
    "draw.rods.show_section": "rod.model.section.Section",
    "draw.networks.show_network": "systems.blocks.block.AbstractBlock",
    "draw.runs.show_rollout": "rod.dynamics.rollout.Trajectory",
    "draw.runs.show_trajectory": "systems.integrate.simulate.Trajectory",
    "draw.runs.show_optimised": "design.optimise.minimise.Optimised",
    "draw.runs.show_history": "design.optimise.minimise.History",
    "draw.plots.show_basis": "rod.model.basis.StrainBasis",
    "draw.plots.show_material": "material.hyperelastic.AbstractHyperelastic",
    "draw.plots.show_fit": "material.fit.TensileFit",
    "draw.plots.show_snapshots": "reduction.backbone.Backbone",
    "draw.plots.show_calibration": "design.calibration.calibration.Calibration",
    "draw.plots.show_sweep": "sweep.sweep.Swept",
    "draw.plots.show_tracks": "vision.discs.Tracks",
    "draw.plots.show_convergence": "view.draw.plots.Convergence",
    "draw.plots.show_work_precision": "view.draw.plots.WorkPrecision",
    "picture.show_scene": "view.raster.scene.Scene",
}
#: The same of functions that make a scene.
_SCENES = {
    "draw.shapes.shape_scene": "sdf.base.AbstractSdf",
    "draw.shapes.surface_scene": "sdf.surface.marching.Surface",
    "draw.shapes.moving_scene": "io.animation.MovingSurface",
    "draw.meshes.mesh_scene": "mesh.mesh.Mesh",
    "draw.meshes.repaired_scene": "mesh.repair.Repaired",
    "draw.bodies.problem_scene": "fem.problem.Problem",
    "draw.bodies.solution_scene": "fem.equilibrium.solve.Solution",
    "draw.bodies.optimised_shape_scene": "design.optimise.shape_loop.OptimisedShape",
    "draw.rods.rod_scene": "rod.model.rod.Rod rod.model.assembly.Assembly",
    "draw.rods.posed_scene": "rod.statics.equilibrium.Solution rod.statics.path.Path",
    "draw.rods.model_scene": "robots.models.supply.Model",
    "draw.rods.body_scene": "systems.blocks.rod_body.RodBody "
    "systems.blocks.rod_body.AssemblyBody",
    "draw.rods.rig_scene": "view.rigging.rig.Rig",
    "draw.robots.robot_scene": "robots.bellows.BellowsActuator robots.bellows.PneuNet "
    "robots.locomotion.Crawler robots.locomotion.Walker robots.printable.BendingActuator "
    "robots.printable.Bellows robots.printable.Finger robots.printable.Hand "
    "robots.printable.Manipulator robots.printable.PlanarActuator",
}


@functools.singledispatch
def show(thing: Any, *at: Any, **options: Any) -> Picture:
    """Draw any noun of the framework; the result is displayed by a notebook and can be saved.

    Shapes, surfaces and meshes; robots and their models; problems, solutions, load paths,
    motions, modes, critical loads; rods, assemblies, sections, strain bases, backbones, rigs;
    materials and their fits; mesh quality, boundary curves, moving surfaces, sweeps, tracks of
    markers; networks, blocks, trajectories; optimisations, calibrations,
    parts; `Convergence` and `WorkPrecision`; a `Scene`. What a search on rods or a buckling
    analysis found needs what was searched, `model=` or `problem=`. In space the picture is
    shaded by pyvista where it is installed and by sorojax itself elsewhere.
    `show.register(Type, function)` adds a noun.

    Args:
        thing: What to draw; lengths in [m], shown in mm.
        *at: Coordinates, of a rod, an assembly or a block that holds one.
        **options: Of the function that draws it: `view.options(thing)` is that function.
            Solid pictures take `view=` ("iso", "front", "top", ..., or a `Camera`) and
            `renderer=`; bodies take `field=`; all take `title=`.

    Returns:
        A picture, with `save(path)`, `figure` and `png`.

    Raises:
        TypeError: If nothing is known about the type.
        ValueError: If the thing cannot be drawn: unbounded, traced, or not finite.

    Example:
        >>> plate = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1))
        >>> view.show(plate, title="A plate").save("plate.svg").name
        'plate.svg'
    """
    draw = _known(thing)
    try:
        inspect.signature(draw).bind(thing, *at, **options)
    except TypeError as error:
        raise TypeError(
            f"view.show: got {_explain.got(thing)} with {_given(at, options)}, {error}. Need "
            f"show({', '.join(inspect.signature(draw).parameters)})."
        ) from None
    return draw(thing, *at, **options)


def _given(at: tuple[Any, ...], options: dict[str, Any]) -> str:
    words = [f"{len(at)} coordinates"] * bool(at) + [f"`{name}=`" for name in options]
    return ", ".join(words) or "nothing else"


def options(thing: Any) -> Any:
    """The function that `show` calls for `thing`; its signature lists the options.

    Args:
        thing: What is to be drawn.

    Returns:
        The function.
    """
    found = show.dispatch(type(thing))
    return _known(thing) if found is show.dispatch(object) else found


def _known(thing: Any) -> Any:
    """What draws `thing`."""
    table = _SCENES | _PICTURES  # the latter where a noun has both
    if (found := _listed(thing, table)) is None:
        raise TypeError(
            f"view.show: got a {type(thing).__name__}, need one of {_nouns(table)}. Register a "
            "function for other types with view.show.register."
        )
    return found if found.__name__.startswith("show_") else _drawing(found)


def _listed(thing: Any, table: dict[str, str]) -> Any:
    """The function of a table for the class of `thing` or the nearest one above it."""
    listed = {noun: function for function, nouns in table.items() for noun in nouns.split()}
    for kind in type(thing).__mro__:
        path = f"{kind.__module__}.{kind.__qualname__}".removeprefix("sorojax.")
        if path in listed:
            module, _, function = listed[path].rpartition(".")
            return getattr(importlib.import_module(f"sorojax.view.{module}"), function)
    return None


def _nouns(table: dict[str, str]) -> str:
    names = {noun.rpartition(".")[2] for nouns in table.values() for noun in nouns.split()}
    return ", ".join(sorted(names))


@functools.cache
def _drawing(make: Callable[..., Scene]) -> Callable[..., Picture]:
    """The function that draws what `make` puts together, with the options of both."""

    @functools.wraps(make)
    def draw(*args: Any, view: Any = "iso", renderer: str = "auto", **options: Any) -> Picture:
        return show_scene(make(*args, **options), view=view, renderer=renderer)

    own = inspect.signature(make)
    more = inspect.signature(show_scene).parameters
    listed = [*own.parameters.values(), more["view"], more["renderer"]]
    listed.sort(key=lambda parameter: parameter.kind)  # `**options` last
    draw.__signature__ = own.replace(parameters=listed)  # type: ignore[attr-defined]
    return draw


# Nouns as scenes: what `show` draws, to be put together anew


def scene_of(thing: Any, *at: Any, **options: Any) -> Scene:
    """A shape, surface, mesh, body, rod, assembly, rig or robot before it is drawn.

    Its `parts` may be joined with those of other scenes and shown as one.

    Args:
        thing: What is to be drawn.
        *at: Coordinates, of a rod or an assembly.
        **options: As of `show`, but `view` and `renderer`.

    Returns:
        The scene, for `show` and `merge_scenes`.

    Raises:
        TypeError: If `thing` has no scene.

    Example:
        `view.show(view.merge_scenes(view.scene_of(ball), view.scene_of(hand, q)), view="top")`
    """
    if (make := _listed(thing, _SCENES)) is None:
        raise TypeError(
            f"view.scene_of: got a {type(thing).__name__}, need one of {_nouns(_SCENES)}. Make "
            "a view.Scene of its parts."
        )
    return make(thing, *at, **options)
