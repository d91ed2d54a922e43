"""Loadings and unloadings of a cyclic tensile test, by its strains in the order of time."""

import numpy as np
from jaxtyping import Bool, Float

_TURN = 0.05  # of the largest strain, that a test goes back where it turns
CYCLES = ("all", "first", "last")


def largest_before(strain: Float[np.ndarray, " points"]) -> Float[np.ndarray, " points"]:
    """The largest strain before each point, minus infinity before the first."""
    return np.concatenate([[-np.inf], np.maximum.accumulate(strain)[:-1]])


def turns(strain: Float[np.ndarray, " points"]) -> list[int]:
    """Points where the strain turns, from loading to unloading first, the last point that goes
    farthest the way of the end included. Turns of less than 5 % of the largest strain are taken
    for noise."""
    gap = _TURN * np.max(np.abs(strain))
    found, best, way = [], 0, 1.0
    for k, e in enumerate(strain):
        ahead = way * (e - strain[best])
        if ahead >= 0:
            best = k
        elif -ahead > gap:
            found.append(best)
            best, way = k, -way
    return [*found, best]


def chosen(
    strain: Float[np.ndarray, " points"], cycles: str
) -> Bool[np.ndarray, " points"] | None:
    """The points of the `cycles` "all"; "first", where the strain is larger than all before; or
    "last", the last loading, as far as the test had been before. `None` where there are none:
    a test of one loading has no last one."""
    if cycles == "all":
        return np.ones(len(strain), bool)
    before = largest_before(strain)
    if cycles == "first":
        return strain > before
    ends = turns(strain)
    if len(ends) < 3:
        return None
    top = len(ends) - 1 - (len(ends) - 1) % 2  # loadings end at even turns
    start, end = ends[top - 1], ends[top]
    number = np.arange(len(strain))
    return (number >= start) & (number <= end) & (strain <= before[start])
