"""`show`: one verb that draws any noun; what draws it is loaded when it is first asked for."""

import functools
import importlib
import inspect
from typing import Any

from sorojax import _explain
from sorojax.view.picture import Picture

#: Noun, module of this floor, function. The class itself is not imported.
_DRAWN_BY = {
    "sorojax.sdf.base.AbstractSdf": ("shapes", "show_shape"),
    "sorojax.sdf.isosurface.Surface": ("shapes", "show_surface"),
    "sorojax.mesh.mesh.Mesh": ("meshes", "show_cells"),
    "sorojax.fem.problem.Problem": ("states", "show_problem"),
    "sorojax.fem.solve.Solution": ("states", "show_solution"),
    "sorojax.fem.solve_volume.CavitySolution": ("states", "show_solution"),
    "sorojax.fem.solve.Path": ("states", "show_path"),
    "sorojax.fem.solve_volume.VolumePath": ("states", "show_path"),
    "sorojax.fem.continuation.Continuation": ("states", "show_path"),
    "sorojax.fem.motion.Motion": ("states", "show_path"),
    "sorojax.fem.modal.Modes": ("states", "show_vibration"),
    "sorojax.fem.buckling.CriticalLoads": ("answers", "show_buckling"),
    "sorojax.fem.critical.CriticalPoint": ("answers", "show_buckling"),
    "sorojax.rod.rod.Rod": ("rods", "show_rod"),
    "sorojax.rod.assembly.Assembly": ("rods", "show_rod"),
    "sorojax.rod.section.Section": ("parts", "show_section"),
    "sorojax.rod.basis.StrainBasis": ("parts", "show_basis"),
    "sorojax.rod.rollout.Rollout": ("runs", "show_rollout"),
    "sorojax.rod.statics.Equilibrium": ("answers", "show_posed"),
    "sorojax.rod.static_path.EquilibriumPath": ("answers", "show_posed"),
    "sorojax.rod.static_arc.ArcPath": ("answers", "show_posed"),
    "sorojax.rod.inverse_kinematics.Reached": ("answers", "show_posed"),
    "sorojax.material.hyperelastic.AbstractHyperelastic": ("parts", "show_material"),
    "sorojax.reduction.backbone.Backbone": ("snapshots", "show_snapshots"),
    "sorojax.robots.bellows.BellowsActuator": ("robots", "show_robot"),
    "sorojax.robots.bending.BendingActuator": ("robots", "show_robot"),
    "sorojax.robots.crawler.Crawler": ("robots", "show_robot"),
    "sorojax.robots.finger.Finger": ("robots", "show_robot"),
    "sorojax.robots.hand.Hand": ("robots", "show_robot"),
    "sorojax.robots.manipulator.Manipulator": ("robots", "show_robot"),
    "sorojax.robots.parts.Bellows": ("robots", "show_robot"),
    "sorojax.robots.planar.PlanarActuator": ("robots", "show_robot"),
    "sorojax.robots.pneunet.PneuNet": ("robots", "show_robot"),
    "sorojax.robots.walker.Walker": ("robots", "show_robot"),
    "sorojax.robots.models_supply.Model": ("parts", "show_model"),
    "sorojax.systems.rod_body.RodBody": ("parts", "show_body"),
    "sorojax.systems.assembly_body.AssemblyBody": ("parts", "show_body"),
    "sorojax.systems.block.AbstractBlock": ("networks", "show_network"),
    "sorojax.systems.simulate.Trajectory": ("runs", "show_trajectory"),
    "sorojax.design.minimise.Optimised": ("runs", "show_optimised"),
    "sorojax.design.history.History": ("runs", "show_history"),
    "sorojax.design.shape_loop.OptimisedShape": ("answers", "show_optimised_shape"),
    "sorojax.design.part.Part": ("answers", "show_part"),
    "sorojax.design.calibration.Calibration": ("answers", "show_calibration"),
    "sorojax.material.fit.TensileFit": ("answers", "show_fit"),
    "sorojax.mesh.repair.Repaired": ("answers", "show_repaired"),
    "sorojax.mesh.quality.Quality": ("records", "show_quality"),
    "sorojax.sdf.surface.Curve": ("records", "show_curve"),
    "sorojax.io.glb_animation.MovingSurface": ("records", "show_moving"),
    "sorojax.sweep.sweep.Swept": ("records", "show_sweep"),
    "sorojax.vision.tracking.Tracks": ("records", "show_tracks"),
    "sorojax.view.rigging.Rig": ("answers", "show_rig"),
    "sorojax.view.charts.Convergence": ("charts", "show_convergence"),
    "sorojax.view.charts.WorkPrecision": ("charts", "show_work_precision"),
    "sorojax.view.scene.Scene": ("stage", "show_scene"),
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
