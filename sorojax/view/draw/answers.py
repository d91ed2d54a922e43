"""What searches found, drawn on what was searched: buckling, rods posed, shapes, fits.

Small nouns: sections, strain modes, materials, bodies as blocks.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.design import Calibration, OptimisedShape, Part
from sorojax.fem import CriticalLoads, CriticalPoint, Problem
from sorojax.material import (
    AbstractHyperelastic,
    TensileFit,
    strain_energy_density,
    uniaxial_stress,
)
from sorojax.mesh import Repaired
from sorojax.rod import Assembly, Rod, Section
from sorojax.view import style
from sorojax.view.draw.meshes import edge_lines, show_cells
from sorojax.view.draw.rod_loads import section_outline
from sorojax.view.draw.rods import show_rod
from sorojax.view.draw.shapes import show_shape
from sorojax.view.draw.states import show_problem
from sorojax.view.panels import panels
from sorojax.view.picture import Panel, Picture
from sorojax.view.raster.camera import View
from sorojax.view.raster.scene import Part as Drawn, Scale, Scene, Surface, joint_extent
from sorojax.view.raster.shell import shell
from sorojax.view.rigging.rig import Rig, pose
from sorojax.view.show import show_scene


def show_section(section: Section, *, title: str = "") -> Picture:
    """A cross-section with its constants; of the middle node if it varies."""
    outer, hole = section_outline(section)
    figure = style.new_figure(5.0, 4.4)
    axes = figure.add_subplot()
    axes.fill(*(1e3 * outer.T), color=style.BODY, ec=style.INK, lw=1.0)
    if hole is not None:
        axes.fill(*(1e3 * hole.T), color="white", ec=style.INK, lw=1.0)
    style.dress_plane(axes, 1e3 * outer.min(axis=0), 1e3 * outer.max(axis=0),
                      "local y [mm]", "local z [mm]")  # fmt: skip
    facts = {"A": (section.area, 1e6, "mm$^2$"),
             "$I_y$": (section.second_moment_y, 1e12, "mm$^4$"),
             "$I_z$": (section.second_moment_z, 1e12, "mm$^4$"),
             "J": (section.torsion_constant, 1e12, "mm$^4$")}  # fmt: skip
    text = "   ".join(
        f"{name} {float(np.median(np.asarray(value))) * factor:.4g} {unit}"
        for name, (value, factor, unit) in facts.items()
    )
    axes.set_title(text, fontsize=style.SMALL - 1, color=style.INK)
    style.title(figure, title)
    return Picture(figure, (Panel(axes),))


def show_material(
    material: AbstractHyperelastic,
    *,
    stretches: tuple[float, float] = (0.7, 2.0),
    points: tuple[Sequence[float], Sequence[float]] | None = None,
    title: str = "",
) -> Picture:
    """Engineering stress of a uniaxial test.

    Args:
        material: A stored energy whose numbers are uniform.
        stretches: First and last stretch [-].
        points: Measured engineering strains [-] and stresses [Pa].
        title: Title of the figure.
    """
    stretch = np.linspace(*stretches, 121)
    stress = np.asarray(uniaxial_stress(material, jnp.asarray(stretch)))
    return _tensile(material, stretch, stress, points, title)


def _tensile(material: AbstractHyperelastic, stretch, stress, points, title: str) -> Picture:
    """Stress [Pa] over stretch, with measured strains and stresses if given."""
    figure = style.new_figure(6.5, 4.2)
    axes = figure.add_subplot()
    axes.axhline(0.0, color=style.GREY, lw=0.8)
    axes.plot(stretch, stress / 1e3, color=style.COLOURS[0], lw=1.9,
              label=type(material).__name__)  # fmt: skip
    if points is not None:
        axes.plot(1 + np.asarray(points[0]), np.asarray(points[1]) / 1e3, "o",
                  color=style.COLOURS[1], ms=6, label="measured")  # fmt: skip
    style.dress(axes, "stretch [-]", "engineering stress [kPa]")
    style.legend(axes, loc="upper left")
    style.title(figure, title)
    return Picture(figure, (Panel(axes),))


def show_body(body: Any, q: Any = None, **options: Any) -> Picture:
    """The rod or assembly of a block with its forces, at its start; options of `show_rod`."""
    model = body.rod if hasattr(body, "rod") else body.assembly
    q = body.q if q is None else q
    return show_rod(model, q, **({"forces": body.forces} | options))


def show_model(model: Any, q: Any = None, **options: Any) -> Picture:
    """The body of a model of a robot; options of `show_rod`. Its `network` is a diagram."""
    return show_body(model.network.blocks["body"], q, **options)


# What searches found, drawn on what was searched: buckling, rods posed, shapes, fits


_STATES = 5


def show_buckling(
    found: CriticalLoads | CriticalPoint,
    *,
    problem: Problem,
    share: float = 0.12,
    view: View = "iso",
    renderer: str = "auto",
    title: str = "",
) -> Picture:
    """The modes in which a body buckles, with their load factors.

    Args:
        found: From `fem.critical_loads`, or a point of a `fem.continuation`.
        problem: The body.
        share: Largest displacement of a mode, of the size of the body.
        view: Camera of a solid body.
        renderer: Of a solid body.
        title: Title of the figure.
    """
    mesh = problem.mesh
    rest, seen = np.asarray(mesh.points), shell(problem.mesh)
    size = float(np.linalg.norm(np.ptp(rest, axis=0)))
    if isinstance(found, CriticalPoint):
        base, shapes = rest + np.asarray(found.displacement), np.asarray(found.shape)[None]
        names = [f"{found.kind} at load factor {float(found.factor):.4g}"]
    else:
        base, shapes = rest, np.asarray(found.shapes)
        names = [f"mode {k + 1}: load factor {f:.4g}"
                 for k, f in enumerate(np.asarray(found.factors))]  # fmt: skip
    if not len(shapes):
        raise ValueError(
            "view.show: there is no critical load ahead of the state. Ask for more modes, or "
            "turn the load round."
        )
    scale, scenes = Scale("amplitude [-]", 0.0, 1.0), []
    for mode in shapes:
        length = np.linalg.norm(mode, axis=1)
        drawn = base + mode * (share * size / length.max())
        parts: list[Drawn] = [edge_lines(mesh, base, colour=style.GREY, width=0.8)]
        parts.append(Surface(drawn, seen.triangles, values=length / length.max()))
        parts.append(edge_lines(mesh, drawn, colour=style.INK, width=0.7))
        scenes.append(Scene(tuple(parts), scale))
    return panels(joint_extent(scenes), names, view=view, renderer=renderer, title=title)


def show_posed(
    found: Any, *, model: Rod | Assembly, title: str = "", **options: Any
) -> Picture:
    """A rod or an assembly where a search ended: at rest under its forces, or at a target.

    Args:
        found: From `rod.static_equilibrium`, `rod.inverse_kinematics` or a path of them.
        model: What was searched.
        title: Title of the figure; how the search ended if omitted.
        **options: As of `show_rod`.
    """
    q = np.asarray(found.q)
    if q.ndim == 2 and len(q) > _STATES:
        q = q[np.unique(np.round(np.linspace(0, len(q) - 1, _STATES)).astype(int))]
    return show_rod(model, q, title=title or _told(found), **options)


def _told(found: Any) -> str:
    """The error or the load factor that a search ended with."""
    if hasattr(found, "error"):
        return f"error {float(found.error):.3g}"
    factor = np.atleast_1d(np.asarray(getattr(found, "factor", ())))
    return f"load factor to {float(factor[-1]):.4g}" if factor.size else ""


def show_optimised_shape(found: OptimisedShape, *, title: str = "", **options: Any) -> Picture:
    """The body with the best dimensions; `found.optimised` has the history."""
    steps = len(np.asarray(found.optimised.history["objective"]))
    text = f"objective {float(found.objective):.4g} after {steps} steps"
    return show_problem(found.problem, title=title or text, **options)


def show_part(part: Part, **options: Any) -> Picture:
    """A part made of densities, by its shape; options of a shape."""
    if part.shape.dim == 2:
        options = {"filled": True} | options
    return show_shape(part.shape, **options)


def show_fit(
    fit: TensileFit, *, points: tuple[Any, Any] | None = None, title: str = ""
) -> Picture:
    """Stress over stretch of a fitted material, as far as it was fitted and, as in the fit,
    taken as incompressible.

    Args:
        fit: From `material.fit_tensile`.
        points: Measured engineering strains [-] and stresses [Pa].
        title: Title of the figure; the error of the fit if omitted.
    """
    low, high = fit.strain_range
    text = f"{fit.rms / 1e3:.3g} kPa rms, {100 * fit.relative_rms:.2g} %"
    stretch = np.linspace(1 + min(low, 0.0), 1 + high, 121)
    stress = np.asarray(_isochoric_stress(fit.material, jnp.asarray(stretch)))
    return _tensile(fit.material, stretch, stress, points, title or text)


@eqx.filter_jit
def _isochoric_stress(
    material: AbstractHyperelastic, stretch: Float[Array, " points"]
) -> Float[Array, " points"]:
    """Slope of the energy along isochoric uniaxial stretch [Pa]."""

    def energy(stretch):
        across = 1 / jnp.sqrt(stretch)
        F = ((stretch, 0.0, 0.0), (0.0, across, 0.0), (0.0, 0.0, across))
        return strain_energy_density(material, F)

    return jax.vmap(jax.grad(energy))(stretch)


def show_calibration(found: Calibration, *, title: str = "") -> Picture:
    """Every record beside its prediction, with twice the standard deviation that the
    parameters leave it; records that were held out have it in their name."""
    checks = [(check, "") for check in found.experiments]
    checks += [(check, ", held out") for check in found.held_out]
    columns = min(len(checks), 3)
    rows = -(-len(checks) // columns)
    figure = style.new_figure(max(5.0, 3.6 * columns), 0.5 + 2.7 * rows)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for spare in grid[len(checks) :]:
        spare.remove()
    for axes, (check, note) in zip(grid, checks, strict=False):
        predicted, error, wide = (
            np.ravel(np.asarray(x, float))
            for x in (check.predicted, check.error, 2 * np.asarray(check.expected))
        )
        reading = np.arange(len(predicted))
        wide = np.broadcast_to(wide, predicted.shape)
        axes.fill_between(reading, predicted - wide, predicted + wide, alpha=0.2,
                          color=style.COLOURS[0], lw=0)  # fmt: skip
        axes.plot(reading, predicted - error, "o", ms=3.5, color=style.COLOURS[1], mew=0,
                  label="measured")  # fmt: skip
        axes.plot(reading, predicted, color=style.COLOURS[0], lw=1.6, label="predicted")
        style.dress(axes, "reading", "", f"{check.name}{note}: {check.rms:.3g} of the noise")
    style.legend(grid[0], loc="best")
    style.title(figure, title)
    return Picture(figure, tuple(Panel(axes) for axes in grid[: len(checks)]))


def show_repaired(repaired: Repaired, **options: Any) -> Picture:
    """The mesh that was repaired; options of a mesh."""
    return show_cells(repaired.mesh, **options)


def show_rig(
    rig: Rig,
    q: Float[Any, " coordinates"] | None = None,
    *,
    view: View = "iso",
    renderer: str = "auto",
    title: str = "",
) -> Picture:
    """The surface of a rig at coordinates `q`, at rest if omitted."""
    triangles = np.asarray(rig.triangles)
    surface = Surface(np.asarray(pose(rig, q)), triangles)
    text = f"{len(triangles)} triangles on {type(rig.model).__name__.lower()}"
    return show_scene(Scene((surface,), title=title or text), view=view, renderer=renderer)
