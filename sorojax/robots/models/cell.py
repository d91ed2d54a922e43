"""One period of a body as a section of a rod: stiffness, force of its gas, mass.

A body that repeats along x and is its own mirror image about the middle of each period is
solved between two planes of symmetry, on which a uniform strain e + k1 y + k2 z is
prescribed and nothing else; gas presses on the walls in between. Beyond small strains the
energy is expanded to the fourth order: it is stationary in the inner displacements, so those
of first order give the third order, and those of second order, one solution each of the same
linear system, the fourth: of material, geometry and a gas that follows the walls.

References:
    Kolpakov, Calculation of the characteristics of thin elastic rods with a periodic
    structure, J. Appl. Math. Mech. 55, 1991.
    Koiter, On the stability of elastic equilibrium, Delft, 1945.
"""

from collections.abc import Callable
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax._jax.jit import once
from sorojax._types import real
from sorojax.material import AbstractHyperelastic, small_strain_moduli
from sorojax.material.kinematics import from_matrix
from sorojax.robots.models.grid import Grid, Piece, cut_grid
from sorojax.robots.printable import Bellows, BendingActuator, Finger, LaidAlong
from sorojax.sdf import AbstractSdf

_BLOCK = 400  # boxes at a time
_POINTS = 2**15  # samples of a compiled program
Index = tuple[int, ...]
_TWO: list[Index] = list(combinations_with_replacement((0, 1), 2))
_THREE: list[Index] = list(combinations_with_replacement((0, 1), 3))
_FOUR: list[Index] = list(combinations_with_replacement((0, 1), 4))
Field = Float[np.ndarray, "nodes 3"]


class Series(NamedTuple):
    """Derivatives of energy less pressure times volume in two inputs a, b: aaa to bbb, and
    aaaa to bbbb."""

    third: Float[np.ndarray, "4"]
    fourth: Float[np.ndarray, "5"]


def energy_series(
    grid: Grid,
    material: AbstractHyperelastic,
    fields: tuple[Field, Field],
    pressures: tuple[float, float],
    solve: Callable[[Field], Field],
) -> Series:
    """The energy of a cell under two inputs.

    Args:
        grid: The cell.
        material: Its solid; energies of the volume count by their bulk modulus alone.
        fields: Linear displacements [m] under each input, prescribed ones exact.
        pressures: Of the gas [Pa] under each input.
        solve: Displacements under a load [N] with nothing prescribed but zeros.
    """
    third, fourth, loads = np.zeros(4), np.zeros(5), [np.zeros_like(fields[0]) for _ in _TWO]
    bulk = float(small_strain_moduli(material)[1])
    for piece in _blocks(grid):
        now, parts = _motion(piece, fields), []
        if piece.solid is not None:
            parts.append(_shape(material, piece.solid, now))
            parts.append(_volume(bulk, piece.samples.modes, piece.solid, now))
        if piece.gas is not None:
            parts.append(_gas(pressures, piece.gas, now))
        for more_third, more_fourth, stresses in parts:
            third, fourth = third + more_third, fourth + more_fourth
            for load, stress in zip(loads, stresses, strict=True):
                force = np.einsum("cqij,qnj->cni", stress, now.slopes, optimize=True)
                np.add.at(load, piece.cells, force)
    moves = [solve(-load) for load in loads]
    forces = [grid.force(u) for u in moves]
    work = np.array([[np.sum(f * u) for u in moves] for f in forces])
    return Series(third, fourth - [_paired(work, index) for index in _FOUR])


class _Motion(NamedTuple):
    """Both displacements at the samples of a piece.

    Attributes:
        slopes: Gradients of the nodes' shapes.
        H, trace: Displacement gradients and their traces.
        second, third: Parts of the change of volume beyond the trace, as forms: doubled the
            one, six times the other are its derivatives.
    """

    slopes: Float[np.ndarray, "points 27 3"]
    H: list[Float[np.ndarray, "boxes points 3 3"]]
    trace: list[Float[np.ndarray, "boxes points"]]
    second: dict[Index, Float[np.ndarray, "boxes points"]]
    third: dict[Index, Float[np.ndarray, "boxes points"]]


def _blocks(grid: Grid):
    for piece in grid.pieces:
        for at in range(0, len(piece.cells), _BLOCK):
            part = slice(at, at + _BLOCK)
            solid, gas = (None if x is None else x[part] for x in (piece.solid, piece.gas))
            yield Piece(piece.cells[part], piece.samples, solid, gas)


def _motion(piece: Piece, fields) -> _Motion:
    slopes = piece.samples.gradient.reshape(len(piece.samples.at), -1, 3)
    H = [np.einsum("qnj,cni->cqij", slopes, u[piece.cells], optimize=True) for u in fields]
    t = [np.einsum("cqii->cq", one) for one in H]
    mixed = {(a, b): np.einsum("cqij,cqji->cq", H[a], H[b]) for a, b in _TWO}
    chain = {(a, b, c): np.einsum("cqij,cqji->cq", H[a] @ H[b], H[c]) for a, b, c in _THREE}
    second = {(a, b): (t[a] * t[b] - mixed[a, b]) / 2 for a, b in _TWO}
    third = {
        # of two matrices the trace of a product of three does not depend on their order
        (a, b, c): (
            t[a] * t[b] * t[c]
            + 2 * chain[a, b, c]
            - t[a] * mixed[b, c]
            - t[b] * mixed[a, c]
            - t[c] * mixed[a, b]
        )
        / 6
        for a, b, c in _THREE
    }
    return _Motion(slopes, H, t, second, third)


def _shape(material, solid: np.ndarray, now: _Motion):
    """Of the isochoric energy."""
    used = np.flatnonzero(solid)
    pair = np.stack([one.reshape(-1, 3, 3)[used] for one in now.H], axis=1)
    weight, third, fourth = solid.ravel()[used], np.zeros(4), np.zeros(5)
    stresses = np.zeros((3, solid.size, 3, 3))
    for at in range(0, len(used), _POINTS):
        some, w = pair[at : at + _POINTS], weight[at : at + _POINTS]
        lack = _POINTS - len(some)
        some = np.concatenate([some, np.zeros((lack, 2, 3, 3))])
        three, four, stress = _derivatives(
            material, jnp.asarray(some), jnp.asarray(np.concatenate([w, np.zeros(lack)]))
        )
        third, fourth = third + np.asarray(three), fourth + np.asarray(four)
        where = used[at : at + _POINTS]
        stresses[:, where] = np.asarray(stress)[:, : len(where)]
    return third, fourth, stresses.reshape(3, *now.H[0].shape)


@once
def _derivatives(material, pairs: Any, weights: Any):
    """Sums of third and fourth derivatives along two directions, and stresses of the second
    order, at rest."""

    def energy(F):
        return material.isochoric_energy(from_matrix(F))

    def one(pair, weight):
        def at(x):
            return jnp.eye(3, dtype=x.dtype) + jnp.einsum("a,aij->ij", x, pair)

        rest = jnp.zeros(2, pair.dtype)
        cubic = jax.jacfwd(jax.jacfwd(jax.jacfwd(lambda x: energy(at(x)))))
        fourth, third = jax.jacfwd(lambda x: (cubic(x),) * 2, has_aux=True)(rest)
        stress = jax.jacfwd(jax.jacfwd(lambda x: jax.grad(energy)(at(x))))(rest)
        return (
            weight * jnp.stack([third[i] for i in _THREE]),
            weight * jnp.stack([fourth[i] for i in _FOUR]),
            weight * jnp.stack([stress[..., a, b] for a, b in _TWO]),
        )

    third, fourth, stress = jax.vmap(one)(pairs, weights)
    return jnp.sum(third, axis=0), jnp.sum(fourth, axis=0), jnp.swapaxes(stress, 0, 1)


def _volume(bulk: float, modes: np.ndarray, solid: np.ndarray, now: _Motion):
    """Of the volume, whose change is linear in each box, as in `Grid`."""
    gram = np.einsum("cq,qm,qn->cmn", solid, modes, modes, optimize=True)
    loose = np.linalg.pinv(gram, 1e-6, hermitian=True)
    seen = [*now.trace, *now.second.values(), *now.third.values()]
    moments = np.einsum("cq,qm,kcq->ckm", solid, modes, np.stack(seen), optimize=True)
    held = np.einsum("ckm,cmn->ckn", moments, loose)
    work = bulk * np.einsum("ckm,clm->kl", held, moments)
    first: dict[Index, int] = {(a,): a for a in range(2)}
    second = {index: 2 + k for k, index in enumerate(_TWO)}
    third = {index: 5 + k for k, index in enumerate(_THREE)}
    three = [
        2 * sum(work[first[one], second[rest]] for one, rest in _split(index))
        for index in _THREE
    ]
    twice = work[2:5, 2:5]
    four = [
        4 * _paired(twice, index)
        + 6 * sum(work[first[one], third[rest]] for one, rest in _split(index))
        for index in _FOUR
    ]
    pressure = np.einsum("ckm,qm->kcq", held, modes)
    stresses = []
    for pair, (a, b) in enumerate(_TWO):
        stress = pressure[2 + pair][..., None, None] * np.eye(3)
        stress = stress + _cofactor(now, b, pressure[a]) + _cofactor(now, a, pressure[b])
        stresses.append(2 * bulk * stress * solid[..., None, None])
    return np.array(three), np.array(four), stresses


def _gas(pressures, gas: np.ndarray, now: _Motion):
    """Of the volume of the gas, less its pressure."""
    swept = {index: float(np.sum(gas * now.second[index])) for index in _TWO}
    swept |= {index: float(np.sum(gas * now.third[index])) for index in _THREE}
    three = [
        -2 * sum(pressures[one[0]] * swept[rest] for one, rest in _split(index))
        for index in _THREE
    ]
    four = [
        -6 * sum(pressures[one[0]] * swept[rest] for one, rest in _split(index))
        for index in _FOUR
    ]
    stresses = [
        -2 * (_cofactor(now, b, pressures[a] * gas) + _cofactor(now, a, pressures[b] * gas))
        for a, b in _TWO
    ]
    return np.array(three), np.array(four), stresses


def _cofactor(now: _Motion, a: int, weight) -> np.ndarray:
    """Derivative of the form `second` in its other place, times a weight."""
    turned = now.trace[a][..., None, None] * np.eye(3) - np.swapaxes(now.H[a], 2, 3)
    return turned * weight[..., None, None] / 2


def _split(index: Index):
    """One place and the rest, in every way."""
    for k in range(len(index)):
        yield index[k : k + 1], index[:k] + index[k + 1 :]


def _paired(form: np.ndarray, index: Index) -> float:
    """A form of pairs at two pairs of four places, the three ways added."""
    a, b, c, d = index
    ways = (((a, b), (c, d)), ((a, c), (b, d)), ((a, d), (b, c)))
    return sum(float(form[_TWO.index(one), _TWO.index(two)]) for one, two in ways)


# One period of a body as a section of a rod: stiffness, push of its gas, mass


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

    Returns:
        Its stiffness, and what its gas does, per length of rod.
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
    answers = [
        grid.displacement(known, field, none) for known, field in zip(held, fields, strict=True)
    ]
    bulge = grid.displacement(held[0], none, grid.swelling)
    forces = [grid.force(u) for u in answers]
    even = np.array([[odd[i] == odd[j] for j in range(3)] for i in range(3)])
    stiffness = np.array([[np.sum(f * u) for u in answers] for f in forces]) * even
    push = [
        0.0 if parity else np.sum(grid.swelling * u)
        for parity, u in zip(odd, answers, strict=True)
    ]
    whole, third, fourth = 2.0 ** len(mirrors) / length, np.zeros(4), np.zeros(5)
    if len(mirrors) == 2:
        # a pressure of which the walls store as much as of a unit strain
        scale = np.sqrt(stiffness[0, 0] / np.sum(grid.swelling * bulge))
        third, fourth = energy_series(
            grid,
            material,
            (answers[0], scale * bulge),
            (0.0, scale),
            lambda load: grid.displacement(held[0], none, load),
        )
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
    rigid = np.stack(
        [
            np.stack([zero, one, zero], 1),
            np.stack([zero, zero, one], 1),
            np.stack([zero, -points[:, 2], points[:, 1]], 1) / np.ptp(points),
        ],
        axis=-1,
    ).reshape(-1, 3)
    flat = (known & active[:, None]).ravel()
    free_to_move = np.repeat(active, 3)
    for _ in range(3):
        size, left = np.linalg.eigh(rigid[flat].T @ rigid[flat])
        if size[0] > 1e-9:
            break
        flat[np.argmax(np.abs(rigid @ left[:, 0]) * (free_to_move & ~flat))] = True
    return flat.reshape(points.shape) | ~active[:, None]


# The cells of bellows, fingers and the bending actuator


def bending_cell(
    robot: BendingActuator, material: AbstractHyperelastic, size: float | None = None
) -> Cell:
    """From the middle of a chamber to the middle of the gap behind it."""
    if robot.num_bellows < 2:
        raise ValueError("robots.model: one bellows has no period, need two. Add bellows.")
    end = (robot.num_bellows + 1) // 2 * robot.pitch
    span = (float(end - robot.pitch / 2), float(end))
    fine = float(robot.wall_thickness) / 2 if size is None else size
    return unit_cell(robot.body(), robot.chambers(), span, material, size=fine, mirrors=(1,))


def bellows_cell(
    bellows: Bellows, material: AbstractHyperelastic, size: float | None = None
) -> Cell:
    """From the middle of a fold to the middle of the gap behind it, laid along x."""
    return _fold(bellows, bellows.solid(), material, size, (1, 2))


def finger_cell(
    finger: Finger, material: AbstractHyperelastic, size: float | None = None
) -> Cell:
    """The same of a finger, with its spine at -y."""
    return _fold(finger.bellows, finger.solid(), material, size, (2,))


def _fold(bellows: Bellows, solid, material, size: float | None, mirrors) -> Cell:
    middle = float(bellows.cap + (bellows.num_folds // 2 + 0.5) * bellows.pitch)
    span = (middle, middle + float(bellows.pitch) / 2)
    fine = float(bellows.wall_thickness) / 2 if size is None else size
    air = LaidAlong(bellows.chamber(), 0)
    laid = LaidAlong(solid, 0) - air
    return unit_cell(laid, air, span, material, size=fine, mirrors=mirrors)
