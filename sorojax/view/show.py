"""`show`: one verb that draws any noun; what draws it is loaded when it is first asked for."""

import functools
import importlib
import inspect
from typing import Any

from sorojax import _explain
from sorojax.view.picture import Panel, Picture
from sorojax.view.raster.camera import View
from sorojax.view.raster.scene import Scene

#: Noun, module of this floor, function. The class itself is not imported.
_DRAWN_BY = {
    "sorojax.sdf.base.AbstractSdf": ("draw.shapes", "show_shape"),
    "sorojax.sdf.surface.marching.Surface": ("draw.shapes", "show_surface"),
    "sorojax.mesh.mesh.Mesh": ("draw.meshes", "show_cells"),
    "sorojax.fem.problem.Problem": ("draw.states", "show_problem"),
    "sorojax.fem.equilibrium.solve.Solution": ("draw.states", "show_solution"),
    "sorojax.fem.equilibrium.volume.CavitySolution": ("draw.states", "show_solution"),
    "sorojax.fem.equilibrium.solve.Path": ("draw.states", "show_path"),
    "sorojax.fem.equilibrium.volume.VolumePath": ("draw.states", "show_path"),
    "sorojax.fem.stability.continuation.Continuation": ("draw.states", "show_path"),
    "sorojax.fem.dynamics.motion.Motion": ("draw.states", "show_path"),
    "sorojax.fem.stability.modal.Modes": ("draw.states", "show_vibration"),
    "sorojax.fem.stability.buckling.CriticalLoads": ("draw.answers", "show_buckling"),
    "sorojax.fem.stability.continuation.CriticalPoint": ("draw.answers", "show_buckling"),
    "sorojax.rod.model.rod.Rod": ("draw.rods", "show_rod"),
    "sorojax.rod.model.assembly.Assembly": ("draw.rods", "show_rod"),
    "sorojax.rod.model.section.Section": ("draw.answers", "show_section"),
    "sorojax.rod.model.basis.StrainBasis": ("draw.figures", "show_basis"),
    "sorojax.rod.dynamics.rollout.Rollout": ("draw.runs", "show_rollout"),
    "sorojax.rod.statics.equilibrium.Equilibrium": ("draw.answers", "show_posed"),
    "sorojax.rod.statics.path.EquilibriumPath": ("draw.answers", "show_posed"),
    "sorojax.rod.statics.path.ArcPath": ("draw.answers", "show_posed"),
    "sorojax.rod.statics.inverse_kinematics.Reached": ("draw.answers", "show_posed"),
    "sorojax.material.hyperelastic.AbstractHyperelastic": ("draw.answers", "show_material"),
    "sorojax.reduction.backbone.Backbone": ("draw.figures", "show_snapshots"),
    "sorojax.robots.bellows.BellowsActuator": ("draw.records", "show_robot"),
    "sorojax.robots.printable.BendingActuator": ("draw.records", "show_robot"),
    "sorojax.robots.crawler.Crawler": ("draw.records", "show_robot"),
    "sorojax.robots.printable.Finger": ("draw.records", "show_robot"),
    "sorojax.robots.printable.Hand": ("draw.records", "show_robot"),
    "sorojax.robots.printable.Manipulator": ("draw.records", "show_robot"),
    "sorojax.robots.parts.Bellows": ("draw.records", "show_robot"),
    "sorojax.robots.printable.PlanarActuator": ("draw.records", "show_robot"),
    "sorojax.robots.pneunet.PneuNet": ("draw.records", "show_robot"),
    "sorojax.robots.walker.Walker": ("draw.records", "show_robot"),
    "sorojax.robots.models.supply.Model": ("draw.answers", "show_model"),
    "sorojax.systems.blocks.rod_body.RodBody": ("draw.answers", "show_body"),
    "sorojax.systems.blocks.rod_body.AssemblyBody": ("draw.answers", "show_body"),
    "sorojax.systems.blocks.block.AbstractBlock": ("draw.networks", "show_network"),
    "sorojax.systems.integrate.simulate.Trajectory": ("draw.runs", "show_trajectory"),
    "sorojax.design.optimise.minimise.Optimised": ("draw.runs", "show_optimised"),
    "sorojax.design.optimise.minimise.History": ("draw.runs", "show_history"),
    "sorojax.design.optimise.shape_loop.OptimisedShape": (
        "draw.answers",
        "show_optimised_shape",
    ),
    "sorojax.design.part.Part": ("draw.answers", "show_part"),
    "sorojax.design.calibration.calibration.Calibration": ("draw.answers", "show_calibration"),
    "sorojax.material.fit.TensileFit": ("draw.answers", "show_fit"),
    "sorojax.mesh.repair.Repaired": ("draw.answers", "show_repaired"),
    "sorojax.mesh.quality.Quality": ("draw.records", "show_quality"),
    "sorojax.sdf.surface.contour.Curve": ("draw.records", "show_curve"),
    "sorojax.io.animation.MovingSurface": ("draw.records", "show_moving"),
    "sorojax.sweep.sweep.Swept": ("draw.records", "show_sweep"),
    "sorojax.vision.tracking.Tracks": ("draw.records", "show_tracks"),
    "sorojax.view.rigging.rig.Rig": ("draw.answers", "show_rig"),
    "sorojax.view.draw.figures.Convergence": ("draw.figures", "show_convergence"),
    "sorojax.view.draw.figures.WorkPrecision": ("draw.figures", "show_work_precision"),
    "sorojax.view.raster.scene.Scene": ("show", "show_scene"),
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
        thing: What to draw.
        *at: Coordinates, of a rod, an assembly or a block that holds one.
        **options: Of the function that draws it: `view.options(thing)` is that function.
            Solid pictures take `view=` ("iso", "front", "top", ..., or a `Camera`) and
            `renderer=`; bodies take `field=`; all take `title=`.

    Raises:
        TypeError: If nothing is known about the type.
        ValueError: If the thing cannot be drawn: unbounded, traced, or not finite.

    Example:
        `view.show(solution, field="von_mises").save("finger.pdf")`
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


# Scenes as pictures, and nouns as scenes: what `show` draws, to be put together anew


#: Noun, module of this floor, function that makes its scene.
_SCENES = {
    "sorojax.sdf.base.AbstractSdf": ("draw.shapes", "shape_scene"),
    "sorojax.sdf.surface.marching.Surface": ("draw.shapes", "surface_scene"),
    "sorojax.mesh.mesh.Mesh": ("draw.meshes", "mesh_scene"),
    "sorojax.fem.problem.Problem": ("draw.states", "problem_scene"),
    "sorojax.fem.equilibrium.solve.Solution": ("draw.states", "solution_scene"),
    "sorojax.fem.equilibrium.volume.CavitySolution": ("draw.states", "solution_scene"),
    "sorojax.rod.model.rod.Rod": ("draw.rods", "rod_scene"),
    "sorojax.rod.model.assembly.Assembly": ("draw.rods", "rod_scene"),
}


def show_scene(scene: Scene, *, view: View = "iso", renderer: str = "auto") -> Picture:
    """One scene, in the plane with axes or shaded in space.

    Args:
        scene: From `scene_of`, or put together from `Surface`, `Lines`, `Arrows` and `Dots`.
        view: Camera of a solid scene.
        renderer: Of a solid scene.
    """
    if scene.dim == 2:
        from sorojax.view.raster.plane import plane_figure

        figure, axes = plane_figure(scene)
        return Picture(figure, (Panel(axes),))
    from sorojax.view.raster.solid import solid_figure

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
