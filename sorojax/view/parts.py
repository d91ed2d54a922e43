"""Small nouns: sections, strain modes, materials, bodies as blocks."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from sorojax.material import AbstractHyperelastic, uniaxial_stress
from sorojax.rod import Section, StrainBasis
from sorojax.view import style
from sorojax.view.figures import show_modes
from sorojax.view.picture import Panel, Picture
from sorojax.view.rods import show_rod
from sorojax.view.sections import section_outline


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


def show_basis(basis: StrainBasis, *, length: float = 1.0, **options: Any) -> Picture:
    """Strain modes along a rod of `length` [m]; options of `show_modes`."""
    figure = show_modes(basis, length, **options)
    return Picture(figure, tuple(Panel(axes) for axes in figure.axes))


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
    stress = np.asarray(uniaxial_stress(material, jnp.asarray(stretch))) / 1e3
    figure = style.new_figure(6.5, 4.2)
    axes = figure.add_subplot()
    axes.axhline(0.0, color=style.GREY, lw=0.8)
    axes.plot(stretch, stress, color=style.COLOURS[0], lw=1.9, label=type(material).__name__)
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
