"""A log-log plot as SVG text, without a plotting library."""

import math
from html import escape

WIDTH, HEIGHT = 600, 340
LEFT, RIGHT, TOP, BOTTOM = 62, 180, 14, 46
COLOURS = (
    "#0b6e99", "#c8553d", "#588157", "#8e5ea2", "#b08900", "#444444", "#d17ba5", "#5b5bd6",
    "#7a5230", "#00a39b",
)  # fmt: skip
Points = dict[str, list[tuple[float, float]]]


def loglog(series: Points, x_label: str, y_label: str) -> str:
    """One line with marks per named series of positive (x, y)."""
    xs = [x for points in series.values() for x, _ in points]
    ys = [y for points in series.values() for _, y in points]
    x, y = _axis(xs, LEFT, WIDTH - RIGHT), _axis(ys, HEIGHT - BOTTOM, TOP)
    parts = [_grid(x, y), _labels(x_label, y_label)]
    for index, (name, points) in enumerate(series.items()):
        parts.append(_series(name, index, sorted(points), x, y))
    width = WIDTH - RIGHT + max(RIGHT, 32 + 6 * max(map(len, series)))  # room for names
    return (
        f'<svg viewBox="0 0 {width} {HEIGHT}" xmlns="http://www.w3.org/2000/svg" '
        f'role="img">{"".join(parts)}</svg>'
    )


class _axis:
    """Decades that hold all values, mapped to pixels."""

    def __init__(self, values: list[float], start: float, stop: float):
        self.low = math.floor(math.log10(min(values)) - 1e-9)
        self.high = max(self.low + 1, math.ceil(math.log10(max(values)) + 1e-9))
        self.start, self.stop = start, stop

    def __call__(self, value: float) -> float:
        part = (math.log10(value) - self.low) / (self.high - self.low)
        return self.start + part * (self.stop - self.start)

    def decades(self) -> range:
        return range(self.low, self.high + 1, max(1, (self.high - self.low) // 6))


def _grid(x: _axis, y: _axis) -> str:
    parts = []
    for k in x.decades():
        at = x(10.0**k)
        parts.append(f'<path class="grid" d="M{at:.1f} {TOP}V{HEIGHT - BOTTOM}"/>')
        parts.append(_text(at, HEIGHT - BOTTOM + 16, _power(k), "middle"))
    for k in y.decades():
        at = y(10.0**k)
        parts.append(f'<path class="grid" d="M{LEFT} {at:.1f}H{WIDTH - RIGHT}"/>')
        parts.append(_text(LEFT - 6, at + 4, _power(k), "end"))
    return "".join(parts)


def _labels(x_label: str, y_label: str) -> str:
    middle = (TOP + HEIGHT - BOTTOM) / 2
    across = _text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 8, escape(x_label), "middle")
    up = _text(0, 0, escape(y_label), "middle")
    return f'{across}<g transform="translate(14 {middle}) rotate(-90)">{up}</g>'


def _series(name: str, index: int, points, x: _axis, y: _axis) -> str:
    colour = COLOURS[index % len(COLOURS)]
    dashes = ' stroke-dasharray="5 3"' if index >= len(COLOURS) else ""
    pixels = [(x(a), y(b)) for a, b in points]
    path = "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in pixels)
    marks = "".join(
        f'<circle cx="{a:.1f}" cy="{b:.1f}" r="4" fill="{colour}">'
        f"<title>{escape(name)}: {p:.3g}, {q:.3g}</title></circle>"
        for (a, b), (p, q) in zip(pixels, points, strict=True)
    )
    row = TOP + 12 + 18 * index
    key = WIDTH - RIGHT + 14
    return (
        f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="1.5"{dashes}/>'
        f'{marks}<circle cx="{key}" cy="{row}" r="4" fill="{colour}"/>'
        + _text(key + 10, row + 4, escape(name), "start")
    )


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{text}</text>'


def _power(k: int) -> str:
    return f'10<tspan dy="-5" font-size="8">{k}</tspan>'
