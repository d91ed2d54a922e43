"""Stress and tangent dP/dF at quadrature points, elementwise on the entries of F that can
differ from the identity; entries that are absent cost nothing.

Energies of the first isochoric invariant have a closed form, others are differentiated at the
point. The tangent may take its geometric parts from a pressure and an isochoric second
Piola-Kirchhoff stress that are extrapolated linearly from the previous iterate (mixed
integration point method): the residual is unchanged, and Newton's method for nearly
incompressible solids needs a fraction of the iterations, since the rotation of a cell within
an iterate is second order in the update but enters J multiplied by the bulk modulus.

Reference: Magisano, Leonetti, Garcea, "How to improve efficiency and robustness of the
Newton method in geometrically non-linear structural problem discretized via
displacement-based finite elements", CMAME 313, 2017.
"""

from functools import cache, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._jax.programs import depends
from sorojax.fem.assembly.space import Modes, coefficients, project
from sorojax.fem.kinematics import (
    AbstractKinematics,
    component_pairs,
    entries_of,
    identity,
    strain_pairs,
)
from sorojax.material.hyperelastic import (
    AbstractHyperelastic,
    finite_share,
    first_invariant_energy,
)
from sorojax.material.kinematics import (
    Entry,
    Tensor,
    cofactor,
    determinant,
    minus,
    plus,
    square_norm,
    times,
)
from sorojax.material.viscoelastic import overstress
from sorojax.math.compiled import Alone
from sorojax.math.linalg.dense import inverse_cube_root

Entries = Float[Array, "entries quad lanes"]


def inverse(F: Tensor) -> Tensor:
    """F^-1."""
    C, shrink = cofactor(F), 1 / determinant(F)
    return tuple(tuple(times(C[j][i], shrink) for j in range(3)) for i in range(3))  # type: ignore


def volume_ratio(kinematics: AbstractKinematics, F: Entries) -> Entry:
    """J of the kept entries."""
    return determinant(kinematics.embed(tuple(F)))


def checked_volume_ratio(
    kinematics: AbstractKinematics, F: Entries, share: Float[Array, "..."] | None
) -> Entry:
    """J of F = I + `share` Grad u: the volume that a solver keeps from inverting."""
    if share is None:
        return volume_ratio(kinematics, F)
    rest = jnp.asarray(identity(kinematics), F.dtype)[:, None, None]
    share = share if jnp.ndim(share) == 0 else share[None]
    return volume_ratio(kinematics, rest + share * (F - rest))


def volume_slopes(kinematics: AbstractKinematics, F: Entries) -> Entries:
    """dJ/dF by the kept entries."""
    C = cofactor(kinematics.embed(tuple(F)))
    return jnp.stack([C[s.row][s.col] for s in kinematics.slots])


def second_piola(kinematics: AbstractKinematics, F: Entries, P: Entries) -> tuple[Entry, ...]:
    """S = F^-1 P, the entries that `strain_pairs` lists."""
    back = inverse(kinematics.embed(tuple(F)))
    return _pairs(kinematics, _product(back, _full(kinematics, P)))


def extrapolated_piola(
    kinematics: AbstractKinematics, F: Entries, step: Entries, P: Entries, rate: Entries
) -> tuple[Entry, ...]:
    """S and its change where F changes by `step` and P by `rate`, as F S = P."""
    back = inverse(kinematics.embed(tuple(F)))
    S = _product(back, _full(kinematics, P))
    turned = _product(_full(kinematics, step), S)
    rows = zip(_full(kinematics, rate), turned, strict=True)
    change = _product(back, tuple(tuple(map(minus, *pair)) for pair in rows))
    return tuple(map(plus, _pairs(kinematics, S), _pairs(kinematics, change)))


def _full(kinematics: AbstractKinematics, entries: Entries) -> Tensor:
    full: list[list[Entry]] = [[0.0] * 3 for _ in range(3)]
    for slot, value in zip(kinematics.slots, entries, strict=True):
        full[slot.row][slot.col] = value
    return tuple(map(tuple, full))  # type: ignore[arg-type]


def _product(a: Tensor, b: Tensor) -> Tensor:
    def entry(i, j):
        return reduce(plus, (times(a[i][k], b[k][j]) for k in range(3)))

    return tuple(tuple(entry(i, j) for j in range(3)) for i in range(3))  # type: ignore


def _pairs(kinematics: AbstractKinematics, S: Tensor) -> tuple[Entry, ...]:
    return tuple(S[i][j] for i, j in strain_pairs(kinematics))


def stack_matrix(F: Tensor, like: Entry) -> Float[Array, "... 3 3"]:
    """The tensor as matrices over points of the shape of `like`."""
    rows = [
        jnp.stack([jnp.broadcast_to(jnp.asarray(e, like.dtype), like.shape) for e in row], -1)
        for row in F
    ]
    return jnp.stack(rows, axis=-2)


# Energy of the change of shape, its stress and its tangent, over arrays of entries of F


def shape_energy(
    material: AbstractHyperelastic, kinematics: AbstractKinematics, F: Entries
) -> Entry:
    """Energy that is not a function of J alone at every point [J/m^3]."""
    return kinematics.shape_energy(material, tuple(F))


def shape_stress(
    material: AbstractHyperelastic, kinematics: AbstractKinematics, F: Entries
) -> Entries:
    """Its first Piola-Kirchhoff stress [Pa]."""
    W = _closed_form(material, kinematics)
    if W is None:
        return jax.grad(lambda F: jnp.sum(shape_energy(material, kinematics, F)))(F)
    x, slopes = _first_invariant(kinematics, F)
    P = _slope(W)(x)[None] * slopes
    return P if (H := overstress(material)) is None else P + _pulled(kinematics, F, H).stress


class ShapeVectors(NamedTuple):
    """The parts of dP/dF, where the energy is one of the first isochoric invariant: an outer
    product of `half` and C = dJ/dF with its transpose, `second` times that of the slopes of the
    invariant (`None`: the energy is linear in it), a multiple `flat` of unity, `weight` times
    d2J / dF dF, and, with an overstress, `row` between entries of one row of F, by the pairs of
    their columns."""

    half: Entries
    C: Entries
    slopes: Entries
    second: Entry | None
    flat: Entry
    weight: Entry
    row: tuple[Entry, ...] | None = None


#: dP/dF of the shape energy, or what it is made of.
Shape = ShapeVectors | Float[Array, "entries entries quad lanes"]


def shape_response(
    material: AbstractHyperelastic, kinematics: AbstractKinematics, F: Entries
) -> tuple[Entries, Shape]:
    """Stress P [Pa], and dP/dF or what it is made of [Pa]."""
    W = _closed_form(material, kinematics)
    if W is None:
        return _differentiated(material, kinematics, F)
    inverse, scale, I1, C = _parts(kinematics, F)
    x, slopes = _first_invariant(kinematics, F)
    first, second = _slope(W)(x), None
    if depends(_slope(W), x):
        second = jax.jvp(_slope(W), (x,), (jnp.ones_like(x),))[1]
    half = (first * scale * inverse)[None] * (5 / 9 * (I1 * inverse)[None] * C - 4 / 3 * F)
    weight = -2 / 3 * first * scale * I1 * inverse
    vectors = ShapeVectors(half, C, slopes, second, 2 * first * scale, weight)
    P = first[None] * slopes
    if (H := overstress(material)) is None:
        return P, vectors
    more = _pulled(kinematics, F, H)
    half, weight = vectors.half + more.half, vectors.weight + more.weight
    return P + more.stress, vectors._replace(half=half, weight=weight, row=more.row)


class _Pulled(NamedTuple):
    """Stress of J^(-2/3) tr(F H F') / 2 and its parts of the tangent, as in `ShapeVectors`."""

    stress: Entries
    half: Entries
    weight: Entry
    row: tuple[Entry, ...]


def _pulled(kinematics: AbstractKinematics, F: Entries, H: Tensor) -> _Pulled:
    inverse, scale, _, C = _parts(kinematics, F)
    full = kinematics.embed(tuple(F))
    turned = _product(full, H)
    FH = jnp.stack([turned[s.row][s.col] for s in kinematics.slots])
    rows = zip(full, turned, strict=True)
    terms = [times(a, b) for two in rows for a, b in zip(*two, strict=True)]
    share = scale * inverse * reduce(plus, terms)
    P = scale[None] * FH - (share / 3)[None] * C
    half = (5 / 18 * share * inverse)[None] * C - (2 / 3 * scale * inverse)[None] * FH
    row = tuple(scale * H[i][j] for i, j in strain_pairs(kinematics))
    return _Pulled(P, half, -share / 3, row)


def stiffened(shape: Shape, bulk: Entry, C: Entries) -> Shape:
    """`shape` with `bulk` times the outer product of C = dJ/dF with itself."""
    if isinstance(shape, ShapeVectors):
        return shape._replace(half=shape.half + (0.5 * bulk)[None] * C)
    return shape + (bulk[None] * C)[:, None] * C[None]


def _differentiated(material, kinematics: AbstractKinematics, F: Entries):
    num = F.shape[0]
    unit = jnp.eye(num, dtype=F.dtype)[:, :, None, None]

    def column(direction):
        return jax.jvp(lambda F: shape_stress(material, kinematics, F), (F,), (direction,))

    units = jnp.broadcast_to(unit, (num, *F.shape))
    return jax.vmap(column, out_axes=(None, 0))(units)


def _closed_form(material: AbstractHyperelastic, kinematics: AbstractKinematics):
    return first_invariant_energy(material) if kinematics.has_volume else None


def _slope(W):
    return lambda x: jax.grad(lambda x: jnp.sum(W(x)))(x)


def _parts(kinematics: AbstractKinematics, F: Entries):
    """1/J, J^(-2/3), I1 and dJ/dF."""
    root = inverse_cube_root(volume_ratio(kinematics, F))
    scale = root * root
    I1 = square_norm(kinematics.embed(tuple(F)))
    return scale * root, scale, I1, volume_slopes(kinematics, F)


def _first_invariant(kinematics: AbstractKinematics, F: Entries) -> tuple[Entry, Entries]:
    """I1_bar - 3 and its derivative by F."""
    inverse, scale, I1, C = _parts(kinematics, F)
    slopes = (2 * scale)[None] * F - (2 / 3 * scale * I1 * inverse)[None] * C
    return scale * I1 - 3, slopes


# dP/dF at the points of a block, between kept entries of F


_NEXT = (1, 2, 0)
_Pairs = tuple[Entry | None, ...]  # of the columns that `strain_pairs` lists
Block = Float[Array, "rows cols quad lanes"]


class Tangent(NamedTuple):
    """dP/dF [Pa]: `blocks` of the pairs of components i <= k, and the `geometric` part, a
    multiple of the kept entries of F and of one, and S of the pairs of columns."""

    blocks: tuple[Block, ...]
    geometric: tuple[Entry | None, ...]


def point_tangent(
    kinematics: AbstractKinematics,
    F: Entries,
    shape: Shape,
    weight: Entry | None,
    S: _Pairs,
) -> Tangent:
    """dP/dF of `shape`, plus `weight` times d2J / dF dF, plus `S` between the entries of one
    row of F."""
    tilted = (None,) * (len(kinematics.slots) + 1)
    if weight is not None:
        tilted = (*(weight * entry for entry in F), weight)
    if isinstance(shape, ShapeVectors):
        if shape.row is not None:
            S = tuple(_sum(s, a) for s, a in zip(S, shape.row, strict=True))
        pairs = zip(S, strain_pairs(kinematics), strict=True)
        S = tuple(_sum(s, shape.flat) if i == j else s for s, (i, j) in pairs)
    rows = [[e for e, _ in entries_of(kinematics, i)] for i in range(kinematics.dim)]
    blocks = [_block(shape, rows[i], rows[k]) for i, k in component_pairs(kinematics.dim)]
    return Tangent(tuple(blocks), (*tilted, *S))


def _sum(a: Entry | None, b: Entry) -> Entry:
    return b if a is None else a + b


def _block(shape: Shape, rows: list[int], cols: list[int]) -> Block:
    if not isinstance(shape, ShapeVectors):
        return _taken(jnp.moveaxis(_taken(shape, rows), 1, 0), cols).swapaxes(0, 1)
    half, C = shape.half, shape.C
    total = _outer(half, C, rows, cols) + _outer(C, half, rows, cols)
    if shape.second is None:
        return total
    return total + _outer(shape.second[None] * shape.slopes, shape.slopes, rows, cols)


def _outer(a: Entries, b: Entries, rows: list[int], cols: list[int]) -> Block:
    return _taken(a, rows)[:, None] * _taken(b, cols)[None]


def _taken(array: Array, numbers: list[int]) -> Array:
    """Rows of an array; a slice where they follow each other, which stays one fast loop."""
    first, last = numbers[0], numbers[-1] + 1
    if numbers == list(range(first, last)):
        return array[first:last]
    return jnp.stack([array[n] for n in numbers])


def tangent_entries(
    kinematics: AbstractKinematics, tangent: Tangent
) -> list[list[list[Float[Array, "quad lanes"]]]]:
    """Entries of the blocks with their geometric part."""
    places = _geometric_places(type(kinematics))

    def entry(value, e: int, f: int):
        number, add = places.get((e, f), (None, jnp.add))
        part = None if number is None else tangent.geometric[number]
        return value if part is None else add(value, part)

    return [
        [
            [entry(block[a, b], e, f) for b, (f, _) in enumerate(entries_of(kinematics, k))]
            for a, (e, _) in enumerate(entries_of(kinematics, i))
        ]
        for (i, k), block in zip(component_pairs(kinematics.dim), tangent.blocks, strict=True)
    ]


@cache
def _geometric_places(kind: type[AbstractKinematics]) -> dict[tuple[int, int], tuple[int, Any]]:
    """Which of the geometric parts is added to or subtracted from an entry of dP/dF: S between
    entries of one row of F, and d2J / dF dF, an entry of F, between others."""
    slots, pairs = kind.slots, strain_pairs(kind)
    at = {(s.row, s.col): number for number, s in enumerate(slots)}
    places = {}
    for e, a in enumerate(slots):
        for f, b in enumerate(slots):
            if a.row == b.row:
                pair = (min(a.col, b.col), max(a.col, b.col))
                places[e, f] = len(slots) + 1 + pairs.index(pair), jnp.add
            elif a.col != b.col:
                third = (3 - a.row - b.row, 3 - a.col - b.col)
                even = (_NEXT[a.row] == b.row) == (_NEXT[a.col] == b.col)
                # entries that are not kept are those of the identity
                if third in at or third[0] == third[1]:
                    places[e, f] = at.get(third, len(slots)), jnp.add if even else jnp.subtract
    return places


# Stress and tangent at points, elementwise on the kept entries of F


class Body(NamedTuple):
    """Data of the energy of a block of cells."""

    material: AbstractHyperelastic
    kinematics: AbstractKinematics
    modes: Modes | None
    volumes: Float[Array, "quad lanes"]


class Response(NamedTuple):
    """Stress P and dP/dF between kept entries of F.

    With pressure modes the bulk stiffness is not in `tangent`: `slopes` holds
    dJ/dF and `stiffness` that between modes.
    """

    stress: Entries
    tangent: Tangent
    slopes: Entries | None
    stiffness: Float[Array, "modes modes lanes"] | None


def energy_density(body: Body, F: Entries) -> Entry:
    """Psi at every point [J/m^3], its volumetric part from the projected J."""
    shape = shape_energy(body.material, body.kinematics, F)
    if not body.kinematics.has_volume:
        return shape
    return shape + body.material.volumetric_energy(_dilatation(body, F))


def pressure(body: Body, F: Entries) -> Entry:
    """dU/dJ at every point [Pa], as projected."""
    slope = _volumetric_slope(body, _dilatation(body, F))
    return project(body.modes, body.volumes, slope)


def response(body: Body, F: Entries, F_before: Entries | None, alone: Alone) -> Response:
    """P and dP/dF, the geometric parts of dP/dF from stresses extrapolated out of
    `F_before`. Without it the tangent is the exact derivative."""
    if F_before is None:
        law = alone(lambda: _law(body, F))
        p = None if law.volumetric is None else law.volumetric[0]
        straight = (None,) * len(strain_pairs(body.kinematics))
        return alone(lambda: _with_tangent(body, F, law, p, straight))
    law, before = alone(lambda: (_law(body, F), _before(body, F_before, F - F_before)))
    return alone(
        lambda: _with_tangent(
            body, F, law, before.p, _geometric_stress(body, F, F_before, law.P, before)
        )
    )


class _Law(NamedTuple):
    """Stress and parts of the tangent of the shape energy; p, bulk stiffness and dJ/dF."""

    P: Entries
    shape: Shape
    volumetric: tuple[Entry, Entry, Entries] | None


class _Before(NamedTuple):
    """Stress of the shape energy at the previous iterate, its change by the step, and the
    extrapolated pressure."""

    P: Entries
    rate: Entries
    p: Entry | None


def _law(body: Body, F: Entries) -> _Law:
    P, shape = shape_response(body.material, body.kinematics, F)
    if not body.kinematics.has_volume:
        return _Law(P, shape, None)
    p, bulk, C = _volumetric(body, F)
    if body.modes is None:
        shape = stiffened(shape, bulk, C)
    return _Law(P, shape, (p, bulk, C))


def _before(body: Body, F: Entries, step: Entries) -> _Before:
    def stress(F):
        return shape_stress(body.material, body.kinematics, F)

    P, rate = jax.jvp(stress, (F,), (step,))
    if not body.kinematics.has_volume:
        return _Before(P, rate, None)
    p, p_rate = jax.jvp(lambda F: pressure(body, F), (F,), (step,))
    return _Before(P, rate, p + p_rate)


def _with_tangent(body: Body, F, law: _Law, weight: Entry | None, S: _Pairs) -> Response:
    """Of the `law`, `weight` times d2J / dF dF and `S` between the entries of a row."""
    if isinstance(law.shape, ShapeVectors):
        weight = _sum(weight, law.shape.weight)
    tangent = point_tangent(body.kinematics, F, law.shape, weight, S)
    if law.volumetric is None:
        return Response(law.P, tangent, None, None)
    p, bulk, C = law.volumetric
    stress = law.P + p[None] * C
    if body.modes is None:
        return Response(stress, tangent, None, None)
    stiffness = [coefficients(body.modes, body.volumes, bulk * mode) for mode in body.modes]
    return Response(stress, tangent, C, jnp.stack(stiffness))


def _geometric_stress(body: Body, F, F_before, P, before: _Before) -> tuple[Entry, ...]:
    """S of the shape energy extrapolated to `F`, minus S(F)."""
    S_before = extrapolated_piola(
        body.kinematics, F_before, F - F_before, before.P, before.rate
    )
    S = [a - b for a, b in zip(S_before, second_piola(body.kinematics, F, P), strict=True)]
    share = finite_share(body.material)
    if share is None:
        return tuple(S)
    # cells of small strains may invert on the way, where S is infinite; theirs is exact
    finite = jnp.broadcast_to(share > 0.9, S[0].shape)
    return tuple(jnp.where(finite, s, jnp.zeros_like(s)) for s in S)


def _dilatation(body: Body, F: Entries) -> Entry:
    return project(body.modes, body.volumes, volume_ratio(body.kinematics, F))


def _volumetric_slope(body: Body, J: Entry) -> Entry:
    return jax.grad(lambda J: jnp.sum(body.material.volumetric_energy(J)))(J)


def _volumetric(body: Body, F: Entries) -> tuple[Entry, Entry, Entries]:
    J = _dilatation(body, F)
    slope, bulk = jax.jvp(lambda J: _volumetric_slope(body, J), (J,), (jnp.ones_like(J),))
    p = project(body.modes, body.volumes, slope)
    return p, bulk, volume_slopes(body.kinematics, F)
