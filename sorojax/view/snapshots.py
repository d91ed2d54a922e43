"""Snapshots of a backbone: where it is, and how it is strained along its length."""

import numpy as np

from sorojax.reduction import Backbone
from sorojax.view import style
from sorojax.view.picture import Panel, Picture

_MOST = 8  # snapshots that are drawn


def show_snapshots(backbone: Backbone, *, title: str = "") -> Picture:
    """Snapshots in the plane of their widest motion, and the strain that changes most, each
    from pale to dark in their order.

    Args:
        backbone: From `reduction.strain_along`.
        title: Title of the figure.
    """
    places, s = 1e3 * np.asarray(backbone.positions), np.asarray(backbone.s)
    up = 1 + int(np.argmax(np.ptp(places[:, :, 1:], axis=(0, 1))))
    change = np.asarray(backbone.change)
    bends = [k for k, name in enumerate(backbone.names) if name.startswith("kappa")]
    most = bends[int(np.argmax(np.abs(change[:, :, bends]).max(axis=(0, 1))))]
    name = backbone.names[most]
    figure = style.new_figure(9.0, 3.8)
    left, right = figure.subplots(1, 2, width_ratios=[1.2, 1])
    shown = np.unique(np.round(np.linspace(0, len(places) - 1, _MOST)).astype(int))
    for k, colour in zip(shown, style.shades(len(shown))[::-1], strict=True):
        left.plot(places[k, :, 0], places[k, :, up], color=colour, lw=2.0)
        right.plot(s, change[k, :, most], color=colour, lw=1.7, label=f"snapshot {k}")
    style.dress(left, "x [mm]", f"{'xyz'[up]} [mm]")
    left.set_aspect("equal", adjustable="datalim")
    style.dress(right, "place along the backbone [-]", f"change of {name} [1/m]")
    style.legend(right, loc="center left", bbox_to_anchor=(1.0, 0.5))
    length = 1e3 * float(backbone.length)
    style.title(figure, title or f"{len(places)} snapshots of a backbone of {length:.3g} mm")
    return Picture(figure, (Panel(left), Panel(right)))
