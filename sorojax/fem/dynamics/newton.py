"""Newton's method for one time step, on the host.

A factor is kept from iteration to iteration and from step to step as long as each solve
with it reduces the residual well: a residual and a back-substitution cost a fraction of
a tangent and its factor. A step that raises the energy is shortened. Products with inertia
and damping are made on the host, in a quarter of the time of compiled ones, which scatter
every entry of the pattern twice.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.fem.assembly import assemble as asm
from sorojax.fem.contact.self_contact import SelfContact, with_partners
from sorojax.fem.contact.statics import update_contact_pairs
from sorojax.fem.equilibrium import rules
from sorojax.fem.equilibrium.linear import Prepared, add_load_stiffness
from sorojax.fem.equilibrium.newton import Newton, Secants, left_to_move, safe_fraction
from sorojax.fem.loads.loads import AbstractLoad
from sorojax.fem.problem import Problem, body, load_force, with_terms
from sorojax.math.compiled import Split, kernel
from sorojax.math.linalg import sparse

Vector = Float[np.ndarray, " dofs"]
Values = Float[np.ndarray, " nnz"]


class Numbers(NamedTuple):
    """Data of the inertia and damping of a step.

    Attributes:
        damping: C [N s/m], where it is not the same in every step.
        lead, drive: See `TimeStep`.
        origin: Displacement at the start [m].
        mass_rate, rate: What mass and damping are multiplied with [1/s^2, 1/s].
        share: How far within the step forces act.
    """

    damping: Array | None
    lead: Array
    drive: Array
    origin: Array
    mass_rate: Array
    rate: Array
    share: Array


class HostInertia:
    """Of the steps of a motion, one after another.

    Attributes:
        origin: Displacement where the step begins [m].
        share: How far within the step forces act.
        values: Stiffness of inertia and damping [N/m].
    """

    def __init__(self, system: sparse.SparseSymmetric, mass: Values, damping: Values | None):
        self._mass = _BothTriangles(system)
        self._matrix, self._damping = self._mass.another(), self._mass.another()
        self._mass.fill(mass)
        self._damped = damping is not None
        if damping is not None:
            self._damping.fill(damping)
        self.origin = self.values = self._pull = self._drag = np.zeros(0)
        self._rates, self.share = (0.0, 0.0), 1.0

    def begin(self, of: Numbers) -> None:
        """Go on with another step."""
        lead, drive, self.origin = (np.asarray(x) for x in (of.lead, of.drive, of.origin))
        rates, self.share = (float(of.mass_rate), float(of.rate)), float(of.share)
        if of.damping is not None:
            self._damped = True
            self._damping.fill(np.asarray(of.damping))
        if rates != self._rates or of.damping is not None:
            self._rates = rates
            with np.errstate(invalid="ignore"):  # a step cut to nothing fails for its matrix
                self.values = rates[0] * self._mass.values
                if self._damped:
                    self.values = self.values + rates[1] * self._damping.values
            self._matrix.fill(self.values)
        self._pull = self._mass @ drive.ravel()
        if self._damped:
            self._drag = self._damping @ lead.ravel()
            self._pull -= self._drag

    def force(self, u: Float[np.ndarray, "nodes dim"]) -> Vector:
        """On the body at displacement `u` [N]."""
        return self._pull - self._matrix @ (u - self.origin).ravel()

    def taken(self, u: Float[np.ndarray, "nodes dim"]) -> float:
        """Energy that damping dissipates in a step whose forces act at `u` [J]."""
        if not self._damped:
            return 0.0
        moved = (u - self.origin).ravel()
        drag = self._rates[1] * (self._damping @ moved) + self._drag
        return float(drag @ moved) / self.share


class _BothTriangles:
    """A symmetric matrix in the pattern of `system` with both its triangles."""

    def __init__(self, system: sparse.SparseSymmetric):
        from scipy.sparse import csr_array

        rows, cols = np.asarray(system.rows), np.asarray(system.cols)
        off = np.flatnonzero(rows != cols)
        number = np.concatenate([np.arange(len(rows)), off])
        at = np.concatenate([rows, cols[off]]), np.concatenate([cols, rows[off]])
        order = csr_array((number + 1.0, at), (system.size, system.size))
        self._number = (order.data - 1).astype(np.int64)
        self._csr, self.values = order, np.zeros(0)

    def another(self) -> "_BothTriangles":
        """One more matrix of the same pattern."""
        made = object.__new__(_BothTriangles)
        made._number, made._csr, made.values = self._number, self._csr.copy(), np.zeros(0)
        return made

    def fill(self, values: Values) -> None:
        self.values, self._csr.data = values, values[self._number]

    def __matmul__(self, x: Vector) -> Vector:
        return self._csr @ x


# Lists of near facets that follow a motion, on the host


_SHARE = 0.25  # of the reach, that points may move before lists are made anew

Nodal = Float[Array, "nodes dim"]


def has_lists(problem: Problem) -> bool:
    """Whether facets of the problem look for each other."""
    return any(isinstance(load, SelfContact) for load in problem.loads)


def listed_at(problem: Problem, now: Nodal, listed: Nodal | None) -> tuple[Problem, Nodal]:
    """`problem` with lists that hold at displacement `now` [m], and the displacement that
    they were made at: `listed` as long as no facet has moved much from there."""
    if listed is not None and not _outdated(problem, np.asarray(now - listed)):
        return problem, listed
    return update_contact_pairs(problem, now), now


def _outdated(problem: Problem, moved: np.ndarray) -> bool:
    """Whether facets moved by a share of the reach: a partner, or any against the mean."""
    for load in problem.loads:
        if isinstance(load, SelfContact):
            own = moved[load.rows(np)].mean(axis=1)
            apart = own[np.asarray(load.partners)] - own[:, None]
            spread = own - own.mean(axis=0)
            drift = max((apart**2).sum(axis=2).max(initial=0.0), (spread**2).sum(axis=1).max())
            if drift > (_SHARE * float(load.reach)) ** 2:  # type: ignore[arg-type]
                return True
    return False


def lists_of(problem: Problem, displacements: Float[Array, "times nodes dim"]) -> tuple:
    """Partners of the facets of each load at every time, `None` for loads without."""
    found = []
    for load in problem.loads:
        if not isinstance(load, SelfContact):
            found.append(None)
            continue
        rows = [with_partners(load, problem.mesh, np.asarray(u)) for u in displacements]
        partners = jnp.stack([row.partners for row in rows])  # type: ignore[arg-type]
        found.append((partners, jnp.stack([row.real for row in rows])))  # type: ignore
    return tuple(found)


def with_lists(loads: tuple, lists: tuple) -> tuple:
    """`loads` with partners of one time."""
    return tuple(
        load if row is None else dataclasses.replace(load, partners=row[0], real=row[1])
        for load, row in zip(loads, lists, strict=True)
    )


@eqx.filter_jit
def longest_share(problem: Problem, du: Nodal) -> Float[Array, ""]:
    """Share of a Newton step [m] after which every load still sees what it acts on."""
    shares = [load.longest_share(du) for load in problem.loads]
    return jax.tree.reduce(jnp.minimum, shares, jnp.ones((), du.dtype))


# Newton's method for one time step, on the host


#: A kept factor is given up where the residual keeps more than this share in an iteration.
_SLOW = 0.2
UNSOUND = "a cell loses most of its volume"


class Kept(NamedTuple):
    """A tangent with its supports applied, whose factor goes on being used, if it has one
    already."""

    matrix: np.ndarray
    largest: float
    factor: sparse.Factor | None = None


class Balance(NamedTuple):
    """Unbalanced force [N] at a state, that of the loads, its largest free entry, the largest
    force that it is judged by, the length that rounding is judged by and the smallest
    J / J_before."""

    residual: np.ndarray
    load: np.ndarray
    norm: float
    reference: float
    length: float
    volume_ratio: float


class Found(NamedTuple):
    """State that a step converged to, unless `reason` says why not, and what is unbalanced
    and comes from loads there; no cell of it has less than `volume` of what it had where the
    step begins, and perhaps much more."""

    u: np.ndarray
    residual: np.ndarray
    load: np.ndarray
    iterations: int
    factorisations: int
    kept: Kept | None
    reason: str
    volume: float = 0.0


class Task(NamedTuple):
    """A step to solve: its terms (see `with_terms`), those without loads that may rest if any
    may, how far nodes may move from where it begins until the others act [m], the force of
    dead loads that change [N], and the numbers of inertia."""

    terms: Split
    few: Split | None
    room: Array
    dead: Array | None
    inertia: Numbers


class Acting(NamedTuple):
    """A problem whose parts were taken apart for the kernels: body and what is prepared once
    per motion, and the terms of a step."""

    fixed: Split
    terms: Split


def acting(problem: Problem, prepared: Prepared) -> Acting:
    """`problem` taken apart."""
    return Acting(Split((body(problem), prepared)), Split((problem.loads, ())))


@kernel
def forces(fixed, terms, u, before):
    """Internal force and that of the loads but dead ones [N], and the smallest
    J / J_before; to be called with what is `acting`."""
    body, prepared = fixed
    body = with_terms(body, terms)
    found = asm.assemble(
        body.space, prepared.geometry, body.material, body.kinematics, u, before
    )
    rest = tuple(load for load in body.loads if not load.dead)
    loaded = load_force(dataclasses.replace(body, loads=rest), u)
    return found.force, loaded.ravel(), found.volume_ratio


@kernel
def tangent(fixed, terms, u, before):
    """Values of the tangent [N/m] of body and loads, to be called with what is `acting`."""
    body, prepared = fixed
    body = with_terms(body, terms)
    args = (body.space, prepared.geometry, body.material, body.kinematics)
    values = asm.assemble(*args, u, before).values
    return add_load_stiffness(body, prepared, u, values)


@kernel
def fixed_rows(fixed, values):
    """Values of a tangent with supports applied."""
    body, prepared = fixed
    return sparse.fix(body.space.system, values, prepared.known)


class StepSolver:
    """Solves the steps of one motion; remembers the last tangent."""

    def __init__(
        self,
        prepared: Prepared,
        problem: Problem,
        newton: Newton,
        inertia: HostInertia,
        dead: np.ndarray,
    ):
        self.prepared, self.newton, self._problem = prepared, newton, problem
        self.system = problem.space.system
        self.solver, self.sees = self.system.solver, has_lists(problem)
        self.known, self.length = np.asarray(prepared.known), float(prepared.length)
        stiff = any(load.stiff_in_positions for load in problem.loads)
        self.reach = float(np.abs(np.asarray(problem.mesh.points)).max()) if stiff else 0.0
        self.free, self.kept = not self.known.any(), None
        self._fixed = Split((body(problem), prepared))
        self._resting = Split((body(problem), _without_resting(problem, prepared)))
        self.inertia, self._steady = inertia, dead

    def begin(self, task: Task) -> None:
        """Go on with another step."""
        self.inertia.begin(task.inertia)
        self._dead = self._steady + (0.0 if task.dead is None else np.asarray(task.dead))
        self._of, self._room = Acting(self._fixed, task.terms), 0.0
        if task.few is not None:
            self._few, self._room = Acting(self._resting, task.few), float(task.room)

    def solve(self, guess: np.ndarray, held: np.ndarray) -> Found:
        """Equilibrium of the step near `guess`, where known unknowns are `held`."""
        settings, u, before, fresh, size = self.newton, guess, guess, 0, np.inf
        now = self._balance(u, self.inertia.origin)
        if not rules.keeps_volume(now.volume_ratio):
            return Found(u, now.residual, now.load, 0, 0, self.kept, UNSOUND)
        volume = now.volume_ratio
        last, refactor, iterations, secants = np.inf, self.kept is None, 0, Secants()
        while True:
            move = 0.0 if self.free else left_to_move(self.known, held, u)
            moves = bool(np.any(move))
            norm, reference = now.norm, now.reference
            if not rules.sound(norm, now.volume_ratio):
                return self._failed(u, iterations, fresh, "an element inverts")
            largest = self.kept.largest if self.kept else 0.0
            rounding = 2 * np.finfo(float).eps * largest * now.length
            small = rules.balanced(norm, reference, rounding, settings.residual_tolerance)
            if rules.converged(small, size, not moves, settings):
                found = u, now.residual, now.load, iterations, fresh
                return Found(*found, self.kept, "", volume)
            exhausted = iterations >= rules.MOST_ITERATIONS * settings.max_iterations
            if exhausted or (fresh >= settings.max_iterations):
                reason = f"no convergence in {iterations} Newton iterations"
                return self._failed(u, iterations, fresh, reason)
            slow = iterations > 0 and norm > _SLOW * last and not small
            if refactor or slow or moves:
                secants.clear()
                if not self._renew(u, before):
                    return self._failed(u, iterations, fresh, "the tangent is singular")
                refactor, fresh = False, fresh + 1
            last, iterations = norm, iterations + 1
            rhs = -now.residual
            if moves:
                rhs = rhs - self.solver.product(self._values, np.asarray(move))
            rhs[self.known] = 0.0
            factor = self._factor()
            if factor is None:
                return self._failed(u, iterations, fresh, "the tangent is singular")
            du = (secants.solve(factor, rhs) + move).reshape(u.shape)
            slope = None if moves else -float(rhs @ du.ravel())
            before = u
            u, now, size = self._advance(u, du, slope)
            volume *= now.volume_ratio
            if not moves:
                change = now.residual + rhs
                change[self.known] = 0.0
                secants.add((u - before).ravel(), change)

    def _renew(self, u, before) -> bool:
        matrix = np.asarray(tangent(self._acting(u), u, before)) + self.inertia.values
        self._values = matrix
        if not self.free:
            matrix = fixed_rows((self._fixed,), matrix)
        return self.keep(np.asarray(matrix))

    def _factor(self) -> sparse.Factor | None:
        kept = self.kept
        assert kept is not None
        if kept.factor is None or not self.solver.holds(kept.factor):
            kept = self.kept = kept._replace(factor=self.solver.factor(kept.matrix))
        return kept.factor

    def keep(self, matrix: np.ndarray) -> bool:
        """Go on with the factor of `matrix`; False if it is not finite."""
        self.kept = Kept(matrix, float(np.abs(matrix).max()))
        return bool(np.isfinite(self.kept.largest))

    def _acting(self, u) -> Acting:
        """Body and loads that act at `u`: a contact that is out of reach is left out, as long
        as no node has moved further than it leaves room for."""
        if self._room > 0:
            moved = np.sqrt(u.shape[1]) * np.abs(u - self.inertia.origin).max()
            if moved < self._room:
                return self._few
        return self._of

    def _balance(self, u, before) -> Balance:
        """Forces of body and loads from a compiled kernel, inertia by a product here."""
        found = forces(self._acting(u), u, before)
        internal, load, ratio = (np.asarray(x) for x in found)
        load = load + self._dead
        driven = load + self.inertia.force(u)
        residual = internal - driven
        size, reference = np.abs(residual), np.abs(driven).max()
        norm = size.max()
        if not self.free:
            norm = np.where(self.known, 0.0, size).max()
            reference = max(reference, np.where(self.known, size, 0.0).max())
        length = np.abs(u).max() + self.length + self.reach
        return Balance(residual, load, float(norm), float(reference), length, float(ratio))

    def _advance(self, u, du, slope):
        """The state after a step, shortened where a cell would collapse or the energy has
        turned at its end."""
        if self.sees:
            du = float(longest_share(self._problem, jnp.asarray(du))) * du
        new = u + du
        now = self._balance(new, u)
        if not rules.keeps_volume(now.volume_ratio):
            du = float(safe_fraction(self._problem, self.prepared, u, du)) * du
            new = u + du
            now = self._balance(new, u)
        size = rules.relative_size(du, new, self.length)
        if slope is None:
            return new, now, size
        share = 1.0
        for _ in range(rules.MAX_SHORTENINGS):
            end = float(np.where(self.known, 0.0, now.residual) @ du.ravel())
            if not rules.turned(slope, end):
                break
            share = rules.shortened(share, slope, end)
            new = u + share * du
            now = self._balance(new, u)
        return new, now, share * size

    def _failed(self, u, iterations: int, fresh: int, reason: str) -> Found:
        self.kept = None
        none = np.zeros(u.size)
        return Found(u, none, none, iterations, fresh, None, reason)


def may_rest(load: AbstractLoad) -> bool:
    """Whether there are places where the load is known not to act."""
    return type(load).room is not AbstractLoad.room


def _without_resting(problem: Problem, prepared: Prepared) -> Prepared:
    """`prepared` without the slots of loads that may rest."""
    rests: list[bool] = []

    def look():
        curved = (load for load in problem.loads if load.curved_part(problem) is not None)
        rests.extend(map(may_rest, curved))
        return jnp.zeros(())

    jax.eval_shape(look)
    slots = zip(prepared.group_slots, rests, strict=True)
    return prepared._replace(group_slots=tuple(rows for rows, rest in slots if not rest))
