"""Force of a reduced body by a few weighted cells (hyper-reduction), with its stiffness and its
Maxwell branches.

As no weight is negative, the sum is an energy.

Reference:
    Farhat, Chapman, Avery, Structure-preserving, stability, and accuracy properties of the
    energy-conserving sampling and weighting method for the hyper reduction of nonlinear finite
    element dynamic models, Int. J. Num. Meth. Eng. 102, 2015.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import fem
from sorojax._jax.jit import once
from sorojax.fem.assembly.energy import (
    Body,
    Entries,
    Response,
    energy_density,
    response,
    tangent_entries,
)
from sorojax.fem.assembly.geometry import deformation, quadrature_points
from sorojax.fem.kinematics import component_pairs, entries_of, green_rates, strain_pairs
from sorojax.fem.problem import body as bare, body_at, load_force
from sorojax.material.viscoelastic import (
    Overstressed,
    inverse_strain,
    isochoric_strain,
    pairs,
)
from sorojax.systems.blocks.fem_body import FemBody
from sorojax.systems.blocks.modal_basis import (
    Basis,
    Modes,
    displacement,
)
from sorojax.systems.blocks.modal_body import (
    AbstractModalForce,
    Polynomial,
    taylor,
)

#: Derivative of a stress at the points, by the numbers of two entries of F.
Tangents = dict[tuple[int, int], Float[Array, "quad cells"]]


class Branches(NamedTuple):
    """Maxwell branches of the chosen cells.

    Attributes:
        moduli: Shear moduli g_i mu [Pa].
        times: [s].
    """

    moduli: Float[Array, "branches #quad #cells"]
    times: Float[Array, " branches"]


class SampledForce(AbstractModalForce):
    """The force of a few cells, each times a weight.

    Branch i of a viscoelastic body has the stress g_i mu A_i with dA_i/dt = (C^-1 - A_i) /
    tau_i (`material.Viscoelastic`). Here A_i is C^-1 of the body at coordinates q_i, and
    dq_i/dt = (q - q_i) / tau_i: the same as long as C^-1 is linear in what the body moves in
    tau_i, with as many states as shapes in place of some for each point.

    Attributes:
        body: Data of the energy of the chosen cells.
        rest: Kept entries of F at q = 0.
        slopes: Their derivatives by the modal coordinates [1/m].
        volumes: Of the quadrature points, times the weight of their cell [m^3].
        loads: Force of the loads that are not driven.
        trained: Largest change of an entry of F that the training has seen; None without one.
        branches: Of a viscoelastic body; None without any.
        viscosity: Of `fem.KelvinVoigt` in the chosen cells [Pa s]; None without it.
    """

    body: Body
    rest: Entries
    slopes: Float[Array, "modes entries quad cells"]
    volumes: Float[Array, "quad cells"]
    loads: Polynomial
    trained: Float[Array, ""] | None = None
    branches: Branches | None = None
    viscosity: Float[Array, " #cells"] | None = None

    @property
    def is_trained(self):
        return self.trained is not None

    @property
    def relaxation_times(self):
        return None if self.branches is None else self.branches.times

    def viscous(self, q, v):
        if self.viscosity is None:
            return jnp.zeros_like(v)
        return _braking(self, q, v)

    def viscous_matrix(self, q: Modes) -> Float[Array, "modes modes"]:
        """C(q) [1/s] of the viscosity: what rotates is not held back."""
        return self._between(self._viscous_tangent(self._gradients(q)))

    def _viscous_tangent(self, F: Entries) -> Tangents:
        """Derivative of the stress by the rate H of F, viscosity (F F'_ik 1_jl + F_il F_kj)."""
        assert self.viscosity is not None
        slots, eta = self.body.kinematics.slots, self.viscosity[None]
        at = {(s.row, s.col): F[number] for number, s in enumerate(slots)}

        def entry(a, b):
            total = jnp.zeros_like(F[0])
            if (a.row, b.col) in at and (b.row, a.col) in at:
                total = at[a.row, b.col] * at[b.row, a.col]
            if a.col == b.col:
                both = [k for k in range(3) if (a.row, k) in at and (b.row, k) in at]
                total = total + sum(at[a.row, k] * at[b.row, k] for k in both)
            return eta * total

        every = list(enumerate(slots))
        return {(e, f): entry(a, b) for e, a in every for f, b in every}

    def viscous_stiffness(self, q: Modes, v: Modes) -> Float[Array, "modes modes"]:
        """Derivative of C(q) v by q."""
        F, H = self._gradients(q), jnp.tensordot(v, self.slopes, 1)
        count = F.shape[0]
        ways = jnp.broadcast_to(jnp.eye(count)[:, :, None, None], (count, *F.shape))
        one = jax.vmap(lambda way: jax.jvp(lambda F: self._viscous_stress(F, H), (F,), (way,)))
        found = one(ways)[1]
        every = range(count)
        return self._between({(e, f): found[f, e] for e in every for f in every})

    def _viscous_stress(self, F: Entries, H: Entries) -> Entries:
        """First Piola-Kirchhoff stress 2 viscosity F dE/dt, for the rate H of F."""
        assert self.viscosity is not None
        kinematics = self.body.kinematics
        at = {(s.row, s.col): number for number, s in enumerate(kinematics.slots)}
        rates = {}
        pairs = strain_pairs(kinematics)
        for (j, k), rate in zip(pairs, green_rates(kinematics, F, H), strict=True):
            rates[j, k] = rates[k, j] = rate
        total = [
            sum(F[at[s.row, k]] * rates[k, s.col] for k in range(3) if (s.row, k) in at)
            for s in kinematics.slots
        ]
        return 2 * self.viscosity[None, None] * jnp.stack(total)

    def _between(self, tangent: Tangents) -> Float[Array, "modes modes"]:
        """Sum over the points of dP_e/dF_f between the slopes."""
        # points last, so that many members are one product of matrices
        every, count = range(self.slopes.shape[1]), self.slopes.shape[0]
        weighed = {at: (self.volumes * entry)[None] for at, entry in tangent.items()}
        bent = [sum(weighed[e, f] * self.slopes[:, e] for e in every) for f in every]
        flat = self.slopes.reshape(count, -1)
        return jnp.stack(bent, axis=1).reshape(count, -1) @ flat.T

    def with_branches(self, q, relaxed):
        return _of_branches(self, q, relaxed) - self.loads(q)

    def stored_by_branches(self, q, relaxed):
        assert self.branches is not None
        rest = jnp.sum(self.volumes[None] * self.branches.moduli) * 3 / 2
        return self._overstressed(relaxed)._stored(q) - self._stored(q) - rest

    def _overstressed(self, relaxed: Float[Array, "branches modes"]) -> "SampledForce":
        """With the stress that branches bear which have none at `relaxed`."""
        assert self.branches is not None
        inverse = jax.vmap(lambda q: self._strains(inverse_strain, self._gradients(q)))(relaxed)
        stress = jnp.sum(self.branches.moduli[:, None] * inverse, axis=0)
        law = Overstressed(self.body.material, stress)
        return dataclasses.replace(self, body=self.body._replace(material=law))

    def _strains(self, strain: Callable, F: Entries) -> Float[Array, "pairs quad cells"]:
        """Entries of a symmetric tensor of the deformation at the points."""
        return jnp.stack(jnp.broadcast_arrays(*strain(self.body.kinematics.embed(tuple(F)))))

    def _turned(self, strain: Callable, q: Modes) -> Float[Array, "modes pairs quad cells"]:
        """Its derivative by the coordinates."""
        F, one = self._gradients(q), functools.partial(self._strains, strain)
        return jax.vmap(lambda way: jax.jvp(one, (F,), (way,))[1])(self.slopes)

    def relaxing_stiffness(
        self, q: Modes, relaxed: Float[Array, "branches modes"]
    ) -> Float[Array, "modes branches modes"]:
        """Derivative of the force of the cells by the coordinates of the branches."""
        assert self.branches is not None
        strains = self._turned(isochoric_strain, q)
        inverse = jax.vmap(lambda q: self._turned(inverse_strain, q))(relaxed)
        twice = np.array([1.0 if i == j else 2.0 for i, j in pairs(strains.shape[1])])
        weights = self.volumes[None] * self.branches.moduli / 2
        twice = jnp.asarray(twice, q.dtype)[None, :, None, None]
        weighed = weights[:, None, None] * twice[None] * inverse
        return jnp.einsum("mpqc,bnpqc->mbn", strains, weighed)

    def reach(self, q):
        assert self.trained is not None
        return self.strain(q) / self.trained

    def strain(self, q: Modes) -> Float[Array, ""]:
        """Largest change of an entry of F from q = 0."""
        return jnp.max(jnp.abs(jnp.tensordot(q, self.slopes, 1)))

    def __call__(self, q):
        return _of_cells(self, q) - self.loads(q)

    def energy(self, q):
        zero, terms = jnp.zeros_like(q), self.loads.terms
        scaled = tuple(term / (k + 1) for k, term in enumerate(terms))
        return self._stored(q) - self._stored(zero) - Polynomial(scaled)(q) @ q

    def stored_by(self, F: Entries) -> Float[Array, ""]:
        """Energy of the cells [J] with these entries of F."""
        return jnp.sum(self.volumes * energy_density(self.body, F))

    def stiffness(
        self, q: Modes, rate: Float[Array, ""] | float | None = None
    ) -> Float[Array, "modes modes"]:
        """Derivative of the force of the cells: dP/dF at each point, between the slopes; and
        `rate` [1/s] times the derivative of the viscous force by the rates, if it is given."""
        F = self._gradients(q)
        answer = response(self.body, F, None, lambda work: work())
        kinematics, tangent = self.body.kinematics, {}
        blocks = tangent_entries(kinematics, answer.tangent)
        for (i, k), block in zip(component_pairs(kinematics.dim), blocks, strict=True):
            for (e, _), row in zip(entries_of(kinematics, i), block, strict=True):
                for (f, _), entry in zip(entries_of(kinematics, k), row, strict=True):
                    tangent[e, f] = tangent[f, e] = entry
        if rate is not None and self.viscosity is not None:
            braking = self._viscous_tangent(F)
            tangent = {at: entry + rate * braking[at] for at, entry in tangent.items()}
        total = self._between(tangent)
        return total if self.body.modes is None else total + self._bulk(answer)

    def tangent(self, q, rate):
        return self.stiffness(q, rate) - jax.jacfwd(self.loads)(q)

    def _bulk(self, answer: Response) -> Float[Array, "modes modes"]:
        """Stiffness of the pressures of the cells, which couple the points of each."""
        modes, volumes = self.body.modes, self.body.volumes
        assert modes is not None and answer.slopes is not None and answer.stiffness is not None
        turned = jnp.einsum("eqc,meqc->mqc", answer.slopes, self.slopes)
        each = jnp.einsum("aqc,qc,mqc->mac", modes, volumes, turned)
        weights = self.volumes[0] / volumes[0]
        return jnp.einsum("c,mac,abc,nbc->mn", weights, each, answer.stiffness, each)

    def _stored(self, q: Modes) -> Float[Array, ""]:
        return self.stored_by(self._gradients(q))

    def _gradients(self, q: Modes) -> Entries:
        return self.rest + jnp.tensordot(q, self.slopes, 1)


@eqx.filter_custom_jvp
def _of_cells(force: SampledForce, q: Modes) -> Modes:
    """Force of the cells. Its derivative by all coordinates, which implicit steps ask for, is
    one stiffness and not a pass for each."""
    return jax.grad(force._stored)(q)


@_of_cells.def_jvp
def _(primals, tangents):
    (force, q), (numbers, way) = primals, tangents
    found = jax.grad(force._stored)(q)
    change = jnp.zeros_like(found) if way is None else force.stiffness(q) @ way
    if any(leaf is not None for leaf in jax.tree.leaves(numbers, is_leaf=lambda x: x is None)):
        by_numbers = eqx.filter_jvp(lambda f: jax.grad(f._stored)(q), (force,), (numbers,))[1]
        change = change + by_numbers
    return found, change


def _braked(force: SampledForce, q: Modes, v: Modes) -> Modes:
    """Force of the viscosity."""
    stress = force._viscous_stress(force._gradients(q), jnp.tensordot(v, force.slopes, 1))
    return jnp.einsum("eqc,qc,meqc->m", stress, force.volumes, force.slopes)


@eqx.filter_custom_jvp
def _braking(force: SampledForce, q: Modes, v: Modes) -> Modes:
    """The same; its derivatives by all coordinates and rates are two matrices."""
    return _braked(force, q, v)


@_braking.def_jvp
def _(primals, tangents):
    (force, q, v), (numbers, way, speed) = primals, tangents
    found = _braked(force, q, v)
    change = jnp.zeros_like(v) if speed is None else force.viscous_matrix(q) @ speed
    if way is not None:
        change = change + force.viscous_stiffness(q, v) @ way
    if any(leaf is not None for leaf in jax.tree.leaves(numbers, is_leaf=lambda x: x is None)):
        change = change + eqx.filter_jvp(lambda f: _braked(f, q, v), (force,), (numbers,))[1]
    return found, change


@eqx.filter_custom_jvp
def _of_branches(
    force: SampledForce, q: Modes, relaxed: Float[Array, "branches modes"]
) -> Modes:
    """Force of the cells with their branches."""
    return jax.grad(force._overstressed(relaxed)._stored)(q)


@_of_branches.def_jvp
def _(primals, tangents):
    (force, q, relaxed), (numbers, way, back) = primals, tangents
    now = force._overstressed(relaxed)
    found = jax.grad(now._stored)(q)
    change = jnp.zeros_like(found) if way is None else now.stiffness(q) @ way
    if back is not None:
        slopes = force.relaxing_stiffness(q, relaxed)
        change = change + jnp.tensordot(slopes, back, 2)
    if any(leaf is not None for leaf in jax.tree.leaves(numbers, is_leaf=lambda x: x is None)):
        by_numbers = eqx.filter_jvp(
            lambda f: jax.grad(f._overstressed(relaxed)._stored)(q), (force,), (numbers,)
        )[1]
        change = change + by_numbers
    return found, change


def sampled_force(
    body: FemBody,
    basis: Basis,
    cells: Int[np.ndarray, " kept"],
    weights: Float[Array | np.ndarray, " kept"],
    points: Int[np.ndarray, " kept"] | None = None,
) -> SampledForce:
    """The force of `cells` of a body, each times its weight, or of one of the quadrature
    `points` of each."""
    free = body.loaded({name: jnp.zeros_like(x.value) for name, x in body.drives.items()})
    chosen = _chosen(free, basis, np.asarray(cells), points)

    def loads(q):
        force = load_force(free, displacement(basis, q))
        return jnp.einsum("kni,ni->k", basis.shapes, force)

    zero = jnp.zeros(len(basis), basis.shapes.dtype)
    made = taylor(loads, zero, 3)
    volumes = chosen.volumes * jnp.asarray(weights)[None]
    return eqx.tree_at(lambda f: (f.volumes, f.loads), chosen, (volumes, made))


@once
def _chosen(problem: fem.Problem, basis: Basis, cells, points) -> SampledForce:
    """The force of some of the cells, or of one point of each."""
    force, count = _cells(problem, basis), problem.mesh.num_cells
    quad = force.volumes.shape[0]

    def taken(leaf):
        if not (eqx.is_array(leaf) and leaf.ndim > 0 and leaf.shape[-1] == count):
            return leaf
        if points is None:
            return leaf[..., cells]
        every = jnp.broadcast_to(leaf, (*leaf.shape[:-2], quad, count))
        return every[..., points, cells][..., None, :]

    energy, rest, volumes = jax.tree.map(taken, (force.body, force.rest, force.volumes))
    return SampledForce(energy, rest, taken(force.slopes), volumes, force.loads)


def _cells(problem: fem.Problem, basis: Basis) -> SampledForce:
    """Every cell of a problem, once."""
    mesh, kinematics = problem.mesh, problem.kinematics
    points = quadrature_points(mesh, kinematics)
    rest = deformation(mesh, kinematics, points, basis.displacement)
    still = jnp.zeros_like(basis.displacement)
    identity = deformation(mesh, kinematics, points, still)
    moved = jax.lax.map(lambda s: deformation(mesh, kinematics, points, s), basis.shapes)
    slopes = moved - identity[None]
    energy = body_at(bare(problem), points)
    none = Polynomial((jnp.zeros(len(basis), rest.dtype),))
    return SampledForce(energy, rest, slopes, points.volumes, none)


def pieces(body: FemBody) -> tuple[Int[np.ndarray, " all"], Int[np.ndarray, " all"] | None]:
    """All that may be chosen: cells, and points of these where no pressure couples them."""
    problem = body.problem
    points = quadrature_points(problem.mesh, problem.kinematics)
    cells, count = np.arange(problem.mesh.num_cells), points.volumes.shape[0]
    if body_at(bare(problem), points).modes is not None:
        return cells, None
    return np.tile(cells, count), np.repeat(np.arange(count), len(cells))
