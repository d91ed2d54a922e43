"""One period of a body as a section of a rod: stiffness, push of its gas, mass.

A body that repeats along x and is its own mirror image about the middle of each period is
solved between two planes of symmetry, on which a uniform strain e + k1 y + k2 z is
prescribed and nothing else; gas presses on the walls in between. Folds and chambers yield as
they do in the solid, so the numbers are those of the drawing and hold no correction.

Reference: Kolpakov, Calculation of the characteristics of thin elastic rods with a periodic
structure, J. Appl. Math. Mech. 55, 1991.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax._types import real
from sorojax.material import AbstractHyperelastic
from sorojax.robots.models_grid import Grid, cut_grid
from sorojax.robots.models_series import energy_series
from sorojax.sdf import AbstractSdf

_SAME = 1e-6  # of the extent: coordinates that are equal


class Cell(eqx.Module):
    """Per length of rod, about the axis through `center`; strains are (e, k1, k2).

    The strain of a fibre at (y, z) from the axis is e + k1 y + k2 z.

    Attributes:
        stiffness: Forces per strain: [N], [N m] and [N m^2].
        push: Force [m^2] and moments [m^3] of the gas per gauge pressure.
        gas: Volume of the gas [m^2].
        compliance: What the walls add to it per pressure, at held strain [m^2/Pa].
        solid: Volume of the solid [m^2].
        second_moments: Integrals of y^2 and z^2 over the solid [m^4].
        center: Axis (y, z), through the centroid of the solid [m].
        third, fourth: Derivatives of the energy in stretch e and pressure p beyond the linear
            answer, eee [N], eep [m^2], epp, ppp and eeee [N], eeep [m^2] and so on: the force
            is the linear one and (eee e^2 + 2 eep e p + epp p^2) / 2 and so on.
    """

    stiffness: Float[Array, "3 3"] = eqx.field(converter=real)
    push: Float[Array, "3"] = eqx.field(converter=real)
    gas: Float[Array, ""] = eqx.field(converter=real)
    compliance: Float[Array, ""] = eqx.field(converter=real)
    solid: Float[Array, ""] = eqx.field(converter=real)
    second_moments: Float[Array, "2"] = eqx.field(converter=real)
    center: Float[Array, "2"] = eqx.field(converter=real)
    third: Float[Array, "4"] = eqx.field(converter=real, default=(0.0,) * 4)
    fourth: Float[Array, "5"] = eqx.field(converter=real, default=(0.0,) * 5)


def unit_cell(
    body: AbstractSdf,
    air: AbstractSdf,
    span: tuple[float, float],
    material: AbstractHyperelastic,
    *,
    size: float,
    mirrors: tuple[int, ...] = (),
) -> Cell:
    """The half period of `body` between x = `span[0]` and `span[1]` [m].

    Small strains; of bodies with both mirrors, which stretch without bending, two terms more.

    Args:
        body: The solid, symmetric about both planes.
        air: Its chambers.
        span: Neighbouring planes of symmetry [m].
        material: Of the solid; its stiffness at rest counts.
        size: Of the boxes [m]; half a wall is good.
        mirrors: Other axes (1: y, 2: z) about whose zero the body is its own mirror image;
            each halves the work.
    """
    lower, upper = (np.array(corner) for corner in body.bounding_box())
    lower[0], upper[0] = span
    lower[list(mirrors)] = 0.0
    grid = cut_grid(body, air, lower, upper, size, material)
    points, length = grid.points - [span[0], 0.0, 0.0], span[1] - span[0]
    volume, center, second = _mass(grid, mirrors)
    fields, none = _uniform(points, center), np.zeros_like(points)
    odd = [_odd(case, mirrors) for case in range(3)]
    held = [_held(points, grid.active, length, mirrors, parity) for parity in odd]
    answers = [grid.displacement(known, field, none)
               for known, field in zip(held, fields, strict=True)]  # fmt: skip
    bulge = grid.displacement(held[0], none, grid.swelling)
    forces = [grid.force(u) for u in answers]
    even = np.array([[odd[i] == odd[j] for j in range(3)] for i in range(3)])
    stiffness = np.array([[np.sum(f * u) for u in answers] for f in forces]) * even
    push = [0.0 if parity else np.sum(grid.swelling * u)
            for parity, u in zip(odd, answers, strict=True)]  # fmt: skip
    whole, third, fourth = 2.0 ** len(mirrors) / length, np.zeros(4), np.zeros(5)
    if len(mirrors) == 2:
        # a pressure of which the walls store as much as of a unit strain
        scale = np.sqrt(stiffness[0, 0] / np.sum(grid.swelling * bulge))
        third, fourth = energy_series(
            grid, material, (answers[0], scale * bulge), (0.0, scale),
            lambda load: grid.displacement(held[0], none, load),
        )  # fmt: skip
        third, fourth = third / scale ** np.arange(4), fourth / scale ** np.arange(5)
    return Cell(
        stiffness=whole * stiffness,
        push=whole * np.array(push),
        gas=whole * grid.gas,
        compliance=whole * np.sum(grid.swelling * bulge),
        solid=whole * volume,
        second_moments=whole * second,
        center=center,
        third=whole * third,
        fourth=whole * fourth,
    )


def _mass(grid: Grid, mirrors) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, centroid and second moments about it, of the solid on the grid."""
    places, whole = grid.places[:, 1:], float(grid.volumes.sum())
    middle = grid.volumes @ places / whole
    middle[[axis - 1 for axis in mirrors]] = 0.0
    return whole, middle, grid.volumes @ (places - middle) ** 2


def _uniform(points: np.ndarray, center: np.ndarray) -> list[np.ndarray]:
    """Displacements of unit strains e, k1, k2 on which cross-sections stay where they are."""
    arms = [np.ones(len(points)), *(points[:, 1:] - center).T]
    return [np.stack([points[:, 0] * a, 0 * a, 0 * a], axis=1) for a in arms]


def _odd(case: int, mirrors: tuple[int, ...]) -> tuple[int, ...]:
    """Mirrors in which a strain changes its sign."""
    return tuple(axis for axis in mirrors if axis == case)


def _held(points, active, length: float, mirrors, odd) -> Bool[np.ndarray, "nodes 3"]:
    """Displacements that symmetry decides: across the planes, or along them where odd; the
    rigid motions that it leaves; and nodes in the gas, which follow the strain."""
    known, near = np.zeros(points.shape, bool), _SAME * np.ptp(points)
    for end in (0.0, length):
        known[np.abs(points[:, 0] - end) < near, 0] = True
    for axis in mirrors:
        on = np.abs(points[:, axis]) < near
        for component in {0, 1, 2} - {axis} if axis in odd else {axis}:
            known[on, component] = True
    zero, one = np.zeros(len(points)), np.ones(len(points))
    rigid = np.stack([
        np.stack([zero, one, zero], 1), np.stack([zero, zero, one], 1),
        np.stack([zero, -points[:, 2], points[:, 1]], 1) / np.ptp(points),
    ], axis=-1).reshape(-1, 3)  # fmt: skip
    flat = (known & active[:, None]).ravel()
    free_to_move = np.repeat(active, 3)
    for _ in range(3):
        size, left = np.linalg.eigh(rigid[flat].T @ rigid[flat])
        if size[0] > 1e-9:
            break
        flat[np.argmax(np.abs(rigid @ left[:, 0]) * (free_to_move & ~flat))] = True
    return flat.reshape(points.shape) | ~active[:, None]
