"""Values with their unit, and the unit that makes their numbers short."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Coloured(NamedTuple):
    """Values per node or per cell in SI units, their name, and what they are measured in."""

    values: Float[np.ndarray, " values"]
    name: str
    unit: str


_STEPS = {
    "Pa": ((1e6, "MPa"), (1e3, "kPa"), (1.0, "Pa")),
    "m": ((1.0, "m"), (1e-3, "mm"), (1e-6, "um")),
    "J/m^3": ((1e6, "MJ/m$^3$"), (1e3, "kJ/m$^3$"), (1.0, "J/m$^3$")),
}


def readable(rows: list[Coloured]) -> tuple[list[np.ndarray], str]:
    """The values of all rows in one unit that gives short numbers, and the label."""
    first = rows[0]
    if first.unit not in _STEPS:
        unit = f" [{first.unit}]" if first.unit else ""
        return [row.values for row in rows], f"{first.name}{unit}"
    flat = np.concatenate([np.ravel(row.values) for row in rows])
    largest = float(np.max(np.abs(flat[np.isfinite(flat)]), initial=0.0))
    factor, unit = _step(largest / 2, first.unit)
    return [row.values / factor for row in rows], f"{first.name} [{unit}]"


def short(value: float, unit: str) -> str:
    """A number with its unit: 12500 Pa as `12.5 kPa`."""
    factor, name = _step(abs(value), unit) if unit in _STEPS else (1.0, unit)
    return f"{value / factor:.3g} {name}".strip()


def _step(value: float, unit: str) -> tuple[float, str]:
    """The largest unit of which `value` has at least one, its size first."""
    steps = _STEPS[unit]
    return next((s for s in steps if value >= s[0]), steps[-1] if value else steps[1])
