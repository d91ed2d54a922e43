"""Pictures, films and reports; the drawing libraries load only where they are used.

Each module is imported when one of its names is first asked for: who looks at a shape does
not wait for the solvers.
"""

import importlib
from typing import TYPE_CHECKING, Any

from sorojax._arguments import check_package as _check_package, public as _public
from sorojax.view.picture import Picture, draw_into
from sorojax.view.raster.camera import Camera, between, orbit
from sorojax.view.raster.extruded import extrude, place
from sorojax.view.raster.scene import Arrows, Dots, Lines, Scale, Scene, Surface, merge_scenes
from sorojax.view.show import options, scene_of, show
from sorojax.view.style import png

_NAMES = {
    "draw.bodies": ("scenes_of",),
    "draw.plots": (
        "Convergence",
        "WorkPrecision",
        "backbone_errors",
        "show_backbones",
        "show_signals",
    ),
    "draw.files": (
        "animate_file",
        "show_file",
    ),
    "film.animation": (
        "Track",
        "animate",
    ),
    "film.film": ("animate_figure",),
    "live_view": (
        "AbstractSink",
        "Feed",
        "Recording",
        "Viser",
        "live",
    ),
    "report": (
        "Number",
        "Section",
        "html_report",
    ),
    "rigging.rig": (
        "pose",
        "rig",
    ),
    "rigging.skin": (
        "bind",
        "deform",
    ),
    "web.actor": ("actor",),
    "web.page": (
        "to_glb",
        "to_html",
    ),
}
_MODULE = {name: module for module, names in _NAMES.items() for name in names}

if TYPE_CHECKING:
    from sorojax.view.draw.bodies import scenes_of
    from sorojax.view.draw.files import animate_file, show_file
    from sorojax.view.draw.plots import (
        Convergence,
        WorkPrecision,
        backbone_errors,
        show_backbones,
        show_signals,
    )
    from sorojax.view.film.animation import Track, animate
    from sorojax.view.film.film import animate_figure
    from sorojax.view.live_view import AbstractSink, Feed, Recording, Viser, live
    from sorojax.view.report import Number, Section, html_report
    from sorojax.view.rigging.rig import pose, rig
    from sorojax.view.rigging.skin import bind, deform
    from sorojax.view.web.actor import actor
    from sorojax.view.web.page import to_glb, to_html

__all__ = [
    "AbstractSink",
    "Arrows",
    "Camera",
    "Convergence",
    "Dots",
    "Feed",
    "Lines",
    "Number",
    "Picture",
    "Recording",
    "Scale",
    "Scene",
    "Section",
    "Surface",
    "Track",
    "Viser",
    "WorkPrecision",
    "actor",
    "animate",
    "animate_figure",
    "animate_file",
    "backbone_errors",
    "between",
    "bind",
    "deform",
    "draw_into",
    "extrude",
    "html_report",
    "live",
    "merge_scenes",
    "options",
    "orbit",
    "place",
    "png",
    "pose",
    "rig",
    "scene_of",
    "scenes_of",
    "show",
    "show_backbones",
    "show_file",
    "show_signals",
    "to_glb",
    "to_html",
]

_check_package(__name__)


def __getattr__(name: str) -> Any:
    if name in _MODULE:
        value = getattr(importlib.import_module(f"sorojax.view.{_MODULE[name]}"), name)
        return globals().setdefault(name, _public(__name__, name, value))
    raise AttributeError(f"module 'sorojax.view' has no attribute {name!r}")
