"""Pictures, films and reports; the drawing libraries load only where they are used.

Each module is imported when one of its names is first asked for: who looks at a shape does
not wait for the solvers.
"""

import importlib
from typing import TYPE_CHECKING, Any

from sorojax._arguments import check_package as _check_package, public as _public
from sorojax.view.camera import Camera as Camera, between as between, orbit as orbit
from sorojax.view.picture import Picture as Picture
from sorojax.view.scene import (
    Arrows as Arrows,
    Dots as Dots,
    Lines as Lines,
    Scale as Scale,
    Scene as Scene,
    Surface as Surface,
    joined as joined,
)
from sorojax.view.show import options as options, show as show
from sorojax.view.stage import scene_of as scene_of
from sorojax.view.style import png as png

_NAMES = {
    "animation": ("Track", "animate"),
    "bodies": ("show_deformed", "show_mesh"),
    "body_film": ("film_of_mesh", "ray"),
    "charts": ("Convergence", "WorkPrecision"),
    "distance": ("show_sdf",),
    "feed": ("Feed", "live"),
    "fields": ("nodal_von_mises",),
    "figures": (
        "backbone_errors", "show_backbones", "show_curve", "show_modes", "show_signals"
    ),
    "files": ("animate_file", "show_file"),
    "film": ("Film", "animate_figure"),
    "live_sinks": ("AbstractSink", "Recording"),
    "live_viser": ("Viser",),
    "report": ("Number", "Section", "html_report"),
    "rigging": ("Rig", "placed", "pose", "rig"),
    "skin": ("Skin", "bind", "deform"),
    "web": ("Page", "to_html"),
    "web_actor": ("Actor", "actor"),
    "web_glb": ("to_glb",),
}  # fmt: skip
_MODULE = {name: module for module, names in _NAMES.items() for name in names}

if TYPE_CHECKING:
    from sorojax.view.animation import Track as Track, animate as animate
    from sorojax.view.bodies import show_deformed as show_deformed, show_mesh as show_mesh
    from sorojax.view.body_film import film_of_mesh as film_of_mesh, ray as ray
    from sorojax.view.charts import Convergence as Convergence, WorkPrecision as WorkPrecision
    from sorojax.view.distance import show_sdf as show_sdf
    from sorojax.view.feed import Feed as Feed, live as live
    from sorojax.view.fields import nodal_von_mises as nodal_von_mises
    from sorojax.view.figures import (
        backbone_errors as backbone_errors,
        show_backbones as show_backbones,
        show_curve as show_curve,
        show_modes as show_modes,
        show_signals as show_signals,
    )
    from sorojax.view.files import animate_file as animate_file, show_file as show_file
    from sorojax.view.film import Film as Film, animate_figure as animate_figure
    from sorojax.view.live_sinks import AbstractSink as AbstractSink, Recording as Recording
    from sorojax.view.live_viser import Viser as Viser
    from sorojax.view.report import (
        Number as Number,
        Section as Section,
        html_report as html_report,
    )
    from sorojax.view.rigging import Rig as Rig, placed as placed, pose as pose, rig as rig
    from sorojax.view.skin import Skin as Skin, bind as bind, deform as deform
    from sorojax.view.web import Page as Page, to_html as to_html
    from sorojax.view.web_actor import Actor as Actor, actor as actor
    from sorojax.view.web_glb import to_glb as to_glb

_check_package(__name__)


def __getattr__(name: str) -> Any:
    if name in _MODULE:
        value = getattr(importlib.import_module(f"sorojax.view.{_MODULE[name]}"), name)
        return globals().setdefault(name, _public(__name__, name, value))
    raise AttributeError(f"module 'sorojax.view' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULE})
