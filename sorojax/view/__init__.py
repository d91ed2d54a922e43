"""Pictures, films and reports; the drawing libraries load only where they are used."""

from sorojax.view.bodies import (
    nodal_von_mises as nodal_von_mises,
    show_deformed as show_deformed,
    show_mesh as show_mesh,
    show_sdf as show_sdf,
)
from sorojax.view.body_film import film_of_mesh as film_of_mesh, ray as ray
from sorojax.view.figures import (
    backbone_errors as backbone_errors,
    show_backbones as show_backbones,
    show_curve as show_curve,
    show_modes as show_modes,
    show_signals as show_signals,
)
from sorojax.view.film import Film as Film, animate as animate
from sorojax.view.report import (
    Number as Number,
    Section as Section,
    html_report as html_report,
)
from sorojax.view.skin import Skin as Skin, bind as bind, deform as deform
from sorojax.view.style import png as png
