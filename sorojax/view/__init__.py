"""Pictures, films and reports; the drawing libraries load only where they are used.

Each module is imported when one of its names is first asked for: who looks at a shape does
not wait for the solvers.
"""

import importlib
from typing import TYPE_CHECKING, Any

from sorojax._arguments import check_package as _check_package, public as _public
from sorojax.view.picture import Picture as Picture
from sorojax.view.raster.camera import Camera as Camera, between as between, orbit as orbit
from sorojax.view.raster.scene import (
    Arrows as Arrows,
    Dots as Dots,
    Lines as Lines,
    Scale as Scale,
    Scene as Scene,
    Surface as Surface,
    joined as joined,
)
from sorojax.view.show import options as options, scene_of as scene_of, show as show
from sorojax.view.style import png as png

_NAMES = {
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
    "film.film": (
        "Film",
        "animate_figure",
    ),
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
        "Rig",
        "placed",
        "pose",
        "rig",
    ),
    "rigging.skin": (
        "Skin",
        "bind",
        "deform",
    ),
    "web.actor": (
        "Actor",
        "actor",
    ),
    "web.page": (
        "Page",
        "to_glb",
        "to_html",
    ),
}
_MODULE = {name: module for module, names in _NAMES.items() for name in names}

if TYPE_CHECKING:
    from sorojax.view.draw.files import animate_file as animate_file, show_file as show_file
    from sorojax.view.draw.plots import (
        Convergence as Convergence,
        WorkPrecision as WorkPrecision,
        backbone_errors as backbone_errors,
        show_backbones as show_backbones,
        show_signals as show_signals,
    )
    from sorojax.view.film.animation import Track as Track, animate as animate
    from sorojax.view.film.film import Film as Film, animate_figure as animate_figure
    from sorojax.view.live_view import (
        AbstractSink as AbstractSink,
        Feed as Feed,
        Recording as Recording,
        Viser as Viser,
        live as live,
    )
    from sorojax.view.report import (
        Number as Number,
        Section as Section,
        html_report as html_report,
    )
    from sorojax.view.rigging.rig import Rig as Rig, placed as placed, pose as pose, rig as rig
    from sorojax.view.rigging.skin import Skin as Skin, bind as bind, deform as deform
    from sorojax.view.web.actor import Actor as Actor, actor as actor
    from sorojax.view.web.page import Page as Page, to_glb as to_glb, to_html as to_html

_check_package(__name__)


def __getattr__(name: str) -> Any:
    if name in _MODULE:
        value = getattr(importlib.import_module(f"sorojax.view.{_MODULE[name]}"), name)
        return globals().setdefault(name, _public(__name__, name, value))
    raise AttributeError(f"module 'sorojax.view' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULE})
