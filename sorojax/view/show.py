"""`show`: one verb that draws any noun; what draws it is loaded when it is first asked for."""

import functools
import importlib
import inspect
from typing import Any

from sorojax import _explain
from sorojax.view.picture import Picture
from sorojax.view.raster.scene import Scene

#: Noun, module of this floor, function. The class itself is not imported.
_DRAWN_BY = {
    "sorojax.sdf.base.AbstractSdf": ("draw.shapes", "show_shape"),
    "sorojax.sdf.surface.marching.Surface": ("draw.shapes", "show_surface"),
    "sorojax.mesh.mesh.Mesh": ("draw.meshes", "show_cells"),
    "sorojax.fem.problem.Problem": ("draw.bodies", "show_problem"),
    "sorojax.fem.equilibrium.solve.Solution": ("draw.bodies", "show_solution"),
    "sorojax.fem.equilibrium.solve.Path": ("draw.bodies", "show_path"),
    "sorojax.fem.dynamics.trajectory.Trajectory": ("draw.bodies", "show_path"),
    "sorojax.fem.stability.modal.Modes": ("draw.bodies", "show_vibration"),
    "sorojax.fem.stability.buckling.CriticalLoads": ("draw.bodies", "show_buckling"),
    "sorojax.fem.stability.continuation.CriticalPoint": ("draw.bodies", "show_buckling"),
    "sorojax.rod.model.rod.Rod": ("draw.rods", "show_rod"),
    "sorojax.rod.model.assembly.Assembly": ("draw.rods", "show_rod"),
    "sorojax.rod.model.section.Section": ("draw.rods", "show_section"),
    "sorojax.rod.model.basis.StrainBasis": ("draw.plots", "show_basis"),
    "sorojax.rod.dynamics.rollout.Trajectory": ("draw.runs", "show_rollout"),
    "sorojax.rod.statics.equilibrium.Solution": ("draw.rods", "show_posed"),
    "sorojax.rod.statics.path.Path": ("draw.rods", "show_posed"),
    "sorojax.material.hyperelastic.AbstractHyperelastic": ("draw.plots", "show_material"),
    "sorojax.reduction.backbone.Backbone": ("draw.plots", "show_snapshots"),
    "sorojax.robots.bellows.BellowsActuator": ("draw.robots", "show_robot"),
    "sorojax.robots.printable.BendingActuator": ("draw.robots", "show_robot"),
    "sorojax.robots.locomotion.Crawler": ("draw.robots", "show_robot"),
    "sorojax.robots.printable.Finger": ("draw.robots", "show_robot"),
    "sorojax.robots.printable.Hand": ("draw.robots", "show_robot"),
    "sorojax.robots.printable.Manipulator": ("draw.robots", "show_robot"),
    "sorojax.robots.printable.Bellows": ("draw.robots", "show_robot"),
    "sorojax.robots.printable.PlanarActuator": ("draw.robots", "show_robot"),
    "sorojax.robots.bellows.PneuNet": ("draw.robots", "show_robot"),
    "sorojax.robots.locomotion.Walker": ("draw.robots", "show_robot"),
    "sorojax.robots.models.supply.Model": ("draw.rods", "show_model"),
    "sorojax.systems.blocks.rod_body.RodBody": ("draw.rods", "show_body"),
    "sorojax.systems.blocks.rod_body.AssemblyBody": ("draw.rods", "show_body"),
    "sorojax.systems.blocks.block.AbstractBlock": ("draw.networks", "show_network"),
    "sorojax.systems.integrate.simulate.Trajectory": ("draw.runs", "show_trajectory"),
    "sorojax.design.optimise.minimise.Optimised": ("draw.runs", "show_optimised"),
    "sorojax.design.optimise.minimise.History": ("draw.runs", "show_history"),
    "sorojax.design.optimise.shape_loop.OptimisedShape": (
        "draw.bodies",
        "show_optimised_shape",
    ),
    "sorojax.design.part.Part": ("draw.shapes", "show_part"),
    "sorojax.design.calibration.calibration.Calibration": ("draw.plots", "show_calibration"),
    "sorojax.material.fit.TensileFit": ("draw.plots", "show_fit"),
    "sorojax.mesh.repair.Repaired": ("draw.meshes", "show_repaired"),
    "sorojax.mesh.quality.Quality": ("draw.meshes", "show_quality"),
    "sorojax.sdf.surface.marching.Curve": ("draw.shapes", "show_curve"),
    "sorojax.io.animation.MovingSurface": ("draw.shapes", "show_moving"),
    "sorojax.sweep.sweep.Swept": ("draw.plots", "show_sweep"),
    "sorojax.vision.discs.Tracks": ("draw.plots", "show_tracks"),
    "sorojax.view.rigging.rig.Rig": ("draw.rods", "show_rig"),
    "sorojax.view.draw.plots.Convergence": ("draw.plots", "show_convergence"),
    "sorojax.view.draw.plots.WorkPrecision": ("draw.plots", "show_work_precision"),
    "sorojax.view.raster.scene.Scene": ("picture", "show_scene"),
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
    """The function that `show` calls for `thing`; its signature lists the options."""
    found = show.dispatch(type(thing))
    return _known(thing) if found is show.dispatch(object) else found


def _known(thing: Any) -> Any:
    for kind in type(thing).__mro__:
        entry = _DRAWN_BY.get(f"{kind.__module__}.{kind.__qualname__}")
        if entry is not None:
            module = importlib.import_module(f"sorojax.view.{entry[0]}")
            return getattr(module, entry[1])
    names = ", ".join(sorted(name.rsplit(".", 1)[1] for name in _DRAWN_BY))
    raise TypeError(
        f"view.show: got a {type(thing).__name__}, need one of {names}. Register a function "
        "for other types with view.show.register."
    )


# Nouns as scenes: what `show` draws, to be put together anew


#: Noun, module of this floor, function that makes its scene.
_SCENES = {
    "sorojax.sdf.base.AbstractSdf": ("draw.shapes", "shape_scene"),
    "sorojax.sdf.surface.marching.Surface": ("draw.shapes", "surface_scene"),
    "sorojax.mesh.mesh.Mesh": ("draw.meshes", "mesh_scene"),
    "sorojax.fem.problem.Problem": ("draw.bodies", "problem_scene"),
    "sorojax.fem.equilibrium.solve.Solution": ("draw.bodies", "solution_scene"),
    "sorojax.rod.model.rod.Rod": ("draw.rods", "rod_scene"),
    "sorojax.rod.model.assembly.Assembly": ("draw.rods", "rod_scene"),
}


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
        `view.show(view.merge_scenes(view.scene_of(ball), view.scene_of(hand, q)), view="top")`
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
