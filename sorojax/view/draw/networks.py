"""A network as a diagram: blocks in layers from left to right, their ports, their wires."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sorojax.systems import AbstractBlock, Network
from sorojax.view import style
from sorojax.view.picture import Picture, plotted

_WIDE, _ROW, _GAP, _BETWEEN = 2.1, 0.24, 0.45, 0.9  # inches
_HEAD = 0.50


def show_network(network: AbstractBlock, *, title: str = "") -> Picture:
    """Blocks with their ports and units, and the wires between them.

    Blocks stand where their signals come from the left; wires that go back run below.
    Inputs of the network have an arrow from outside, those with nothing wired their default.

    Args:
        network: A network; any other block is drawn by itself.
        title: Title of the figure.
    """
    blocks = dict(network.blocks) if isinstance(network, Network) else {"block": network}
    wires = dict(network.wires) if isinstance(network, Network) else {}
    exposed = set(network.exposed) if isinstance(network, Network) else set()
    used = set(wires.values())
    ports = {name: _ports(name, block, used) for name, block in blocks.items()}
    places = _layout(list(blocks), wires, ports)
    right = max(x for x, _ in places.values()) + _WIDE
    low = min(y - _height(ports[name]) for name, (_, y) in places.items())
    back = [w for w in sorted(wires.items()) if _goes_back(w, places)]
    low -= 0.22 * len(back) + 0.1
    figure = style.new_figure(right + 1.6, -low + (0.7 if title else 0.3), layout="none")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(-0.8, right + 0.8)
    axes.set_ylim(low - 0.1, 0.6 if title else 0.2)
    axes.axis("off")
    for name, block in blocks.items():
        _box(axes, name, block, ports[name], places[name], wires, exposed)
    floor = low + 0.1
    colours = _colours(wires)
    for target, source in sorted(wires.items()):
        start = _port(source, ports, places, 1)
        end = _port(target, ports, places, 0)
        if (target, source) in back:
            path, floor = _around(start, end, floor), floor + 0.22
        else:
            path = _bend(start, end)
        _wire(axes, path, colours[source])
    if title:
        style.heading(axes, right / 2, 0.35, title, va="baseline")
    return plotted(figure, [axes])


Ports = tuple[list[tuple[str, str]], list[tuple[str, str]]]


def _ports(owner: str, block: AbstractBlock, used: set[str]) -> Ports:
    """Names and units of inputs, then of the outputs that something reads (at most three
    others)."""
    inputs = [(name, _unit(port)) for name, port in block.inputs.items()]
    outputs = [(name, _unit(port)) for name, port in block.outputs.items()]
    read = [port for port in outputs if f"{owner}.{port[0]}" in used]
    others = [port for port in outputs if port not in read]
    return inputs, read + others[: max(0, 3 - len(read))]


def _unit(port: Any) -> str:
    size = "x".join(map(str, port.shape))
    return " ".join(text for text in (port.unit or "", f"({size})" if size else "") if text)


def _height(ports: Ports) -> float:
    return _HEAD + _ROW * max(len(ports[0]), len(ports[1]), 1) + 0.1


def _layout(
    names: list[str], wires: Mapping[str, str], ports: dict[str, Ports]
) -> dict[str, tuple[float, float]]:
    """Upper left corner of each block: layers by the longest way from a source, loops cut
    where a depth-first walk closes them; rows by the mean height of what feeds them."""
    feeds: dict[str, set[str]] = {name: set() for name in names}
    for target, source in wires.items():
        a, b = source.split(".")[0], target.split(".")[0]
        if a != b:
            feeds[b].add(a)
    layer = _layers(names, feeds)
    columns: dict[int, list[str]] = {}
    for name in names:
        columns.setdefault(layer[name], []).append(name)
    places: dict[str, tuple[float, float]] = {}
    for column in sorted(columns):
        above = {
            name: float(np.mean([places[a][1] for a in feeds[name] if a in places] or [0.0]))
            for name in columns[column]
        }
        order = sorted(columns[column], key=lambda name: -above[name])
        y = 0.0
        for name in order:
            y = min(y, above[name]) if len(order) == 1 else y
            places[name] = (column * (_WIDE + _BETWEEN), y)
            y -= _height(ports[name]) + _GAP
    return places


def _layers(names: list[str], feeds: dict[str, set[str]]) -> dict[str, int]:
    """Layer of each block; a wire that closes a loop does not count."""
    forward: dict[str, set[str]] = {name: set() for name in names}
    state: dict[str, int] = {}

    def walk(name: str) -> None:
        state[name] = 1
        for after in names:
            if name in feeds[after]:
                if state.get(after) == 1:
                    continue
                forward[name].add(after)
                if after not in state:
                    walk(after)
        state[name] = 2

    sources = [name for name in names if not feeds[name]]
    for name in sources + names:
        if name not in state:
            walk(name)
    layer = dict.fromkeys(names, 0)
    for _ in names:
        for name in names:
            for after in forward[name]:
                layer[after] = max(layer[after], layer[name] + 1)
    used = sorted(set(layer.values()))
    return {name: used.index(depth) for name, depth in layer.items()}


def _goes_back(wire: tuple[str, str], places) -> bool:
    target, source = wire
    return places[target.split(".")[0]][0] <= places[source.split(".")[0]][0]


def _port(name: str, ports: dict[str, Ports], places, side: int) -> np.ndarray:
    owner, port = name.split(".", 1)
    x, y = places[owner]
    names = [entry[0] for entry in ports[owner][side]]
    row = names.index(port)
    return np.array([x + side * _WIDE, y - _HEAD - _ROW * (row + 0.5)])


def _box(axes: Any, name: str, block, ports: Ports, place, wires, exposed: set[str]) -> None:
    from matplotlib.patches import FancyBboxPatch

    x, y = place
    high = _height(ports)
    look = {"facecolor": "#f3f6fa", "edgecolor": style.GREY, "linewidth": 1.0}
    round_corners = "round,pad=0,rounding_size=0.08"
    axes.add_patch(FancyBboxPatch((x, y - high), _WIDE, high, round_corners, **look))
    middle, small = x + _WIDE / 2, style.SMALL
    style.write(axes, middle, y - 0.17, name, fontsize=style.LABEL, fontweight="bold")
    kind, look = type(block).__name__, {"color": style.GREY, "style": "italic"}
    style.write(axes, middle, y - 0.37, kind, fontsize=small - 1, **look)
    for side in (0, 1):
        for row, (port, unit) in enumerate(ports[side]):
            at = y - _HEAD - _ROW * (row + 0.5)
            edge = x + side * _WIDE
            full = f"{name}.{port}"
            axes.plot([edge], [at], "s", ms=4, color=style.INK, zorder=5)
            text = f"{port} [{unit}]" if unit else port
            alone = row >= len(ports[1 - side])
            text = _cut(text, 28 if alone else 17)
            inside, ha = (0.09, "left") if side == 0 else (-0.09, "right")
            style.write(axes, edge + inside, at, text, ha=ha, fontsize=small - 1.5)
            if side == 0 and full in exposed:
                _wire(axes, np.array([[edge - 0.6, at], [edge, at]]), style.LOAD)
            elif side == 0 and full not in wires:
                default = block.inputs[port].default
                text = "open" if default is None else f"{default:g}"
                look = {"ha": "right", "fontsize": small - 2, "color": style.GREY}
                style.write(axes, edge - 0.08, at, text, **look)


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "\u2026"


def _wire(axes: Any, path: np.ndarray, colour: str) -> None:
    axes.plot(*path.T, color=colour, lw=1.3, solid_capstyle="round", zorder=3)
    axes.plot(*path[-1], marker=">", color=colour, ms=6, zorder=6, clip_on=False)


def _bend(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """A smooth step from left to right."""
    t = np.linspace(0, 1, 40)
    ease = t * t * (3 - 2 * t)
    return np.stack(
        [start[0] + (end[0] - start[0]) * t, start[1] + (end[1] - start[1]) * ease], 1
    )


def _around(start: np.ndarray, end: np.ndarray, floor: float) -> np.ndarray:
    """Out to the right, along the floor, up on the left, corners rounded."""
    shift = 0.25 + 0.35 * (abs(floor) % 0.9)
    corners = np.array([
        start, [start[0] + shift, start[1]], [start[0] + shift, floor],
        [end[0] - shift, floor], [end[0] - shift, end[1]], end,
    ])  # fmt: skip
    path = [corners[:1]]
    for before, here, after in zip(corners, corners[1:-1], corners[2:], strict=False):
        radius = 0.12
        t = np.linspace(0, 1, 8)[:, None]
        first = here + radius * (before - here) / max(np.linalg.norm(before - here), radius)
        last = here + radius * (after - here) / max(np.linalg.norm(after - here), radius)
        path.append((1 - t) ** 2 * first + 2 * t * (1 - t) * here + t**2 * last)
    return np.concatenate([*path, corners[-1:]])


def _colours(wires: Mapping[str, str]) -> dict[str, str]:
    """One colour per source, so that a signal can be followed."""
    sources = sorted(set(wires.values()))
    return {s: style.COLOURS[k % len(style.COLOURS)] for k, s in enumerate(sources)}
