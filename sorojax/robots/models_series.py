"""What a cell answers beyond small strains: its energy to the fourth order.

The energy is stationary in the displacements inside of the cell. So those of first order give
it to the third order, and those of second order, one solution each of the same linear system,
to the fourth: of the material, of the geometry, and of a gas that follows the walls.

Reference: Koiter, On the stability of elastic equilibrium, Delft, 1945.
"""

from collections.abc import Callable
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sorojax._jax.jit import once
from sorojax.material import AbstractHyperelastic, small_strain_moduli
from sorojax.material.kinematics import from_matrix
from sorojax.robots.models_grid import Grid, Piece

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
        (a, b, c): (t[a] * t[b] * t[c] + 2 * chain[a, b, c]
                    - t[a] * mixed[b, c] - t[b] * mixed[a, c] - t[c] * mixed[a, b]) / 6
        for a, b, c in _THREE
    }  # fmt: skip
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
    three = [2 * sum(work[first[one], second[rest]] for one, rest in _split(index))
             for index in _THREE]  # fmt: skip
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
    three = [-2 * sum(pressures[one[0]] * swept[rest] for one, rest in _split(index))
             for index in _THREE]  # fmt: skip
    four = [-6 * sum(pressures[one[0]] * swept[rest] for one, rest in _split(index))
            for index in _FOUR]  # fmt: skip
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
