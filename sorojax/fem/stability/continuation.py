"""Paths of equilibria over limit points and through bifurcations: their critical points are
located between two states, and the branches that leave them can be followed.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._display import displayed, number, outcome
from sorojax._progress import report
from sorojax.fem.checks import no_peaks
from sorojax.fem.equilibrium.linear import Prepared, prepare
from sorojax.fem.equilibrium.load_stepping import LoadStep, Log, Stats, at_rest, follow
from sorojax.fem.equilibrium.newton import Newton
from sorojax.fem.equilibrium.solve import Path
from sorojax.fem.problem import Problem
from sorojax.fem.stability.arc_length import Loading, PathState, arc_step, tangent_state
from sorojax.fem.stability.modal import tangent_modes
from sorojax.math.status import Status

_MAX_TRIALS = 12


class CriticalPoint(eqx.Module):
    """A state with a singular tangent, its `displacement` [m], and the `shape` of the mode it
    is singular in (largest entry 1).

    `kind` is "limit point", where the load has a maximum or minimum, or "bifurcation", where
    another path crosses. `factor` is that of the load, and `negative` the number of negative
    eigenvalues beside the one that is zero.
    """

    kind: str = eqx.field(static=True)
    factor: Float[Array, ""]
    displacement: Float[Array, "nodes dim"]
    shape: Float[Array, "nodes dim"]
    negative: int = eqx.field(static=True)


def locate(
    loading: Loading, prepared: Prepared, first: PathState, last: PathState, newton: Newton
) -> list[CriticalPoint]:
    """Critical points between two neighbouring states: a limit point where the load turns,
    a bifurcation where the tangent loses or gains an eigenvalue otherwise."""
    turned = first.slope * last.slope < 0
    counts = first.negative_eigenvalues, last.negative_eigenvalues
    changes = abs(counts[1] - counts[0]) if min(counts) >= 0 else 0
    points = []
    if turned:
        ends = first, last
        points.append(_point("limit point", loading, prepared, ends, newton, lambda s: s.slope))
    if changes > turned:
        lower = min(counts)

        def stiffness(state: PathState) -> float:
            modes = tangent_modes(loading.at(state.factor), jnp.asarray(state.u), lower + 1)
            return float(modes.eigenvalues[lower])

        points.append(
            _point("bifurcation", loading, prepared, (first, last), newton, stiffness)
        )
    return [point for point in points if point is not None]


def _point(
    kind: str,
    loading: Loading,
    prepared: Prepared,
    ends: tuple[PathState, PathState],
    newton: Newton,
    test: Callable[[PathState], float],
) -> CriticalPoint | None:
    """The zero of `test` along the path, by regula falsi with halved weights (Illinois)."""
    first, last = ends
    whole = float(np.sum(first.direction * (last.u - first.u)))
    at, values = [0.0, whole], [test(first), test(last)]
    goal = 1e-4 * max(abs(values[0]), abs(values[1]))
    # The update need not be small: along the mode rounding is amplified without bound.
    newton = Newton(newton.residual_tolerance, 1e-3, newton.max_iterations)
    state, best, side = None, np.inf, 0
    for _ in range(_MAX_TRIALS):
        s = (at[0] * values[1] - at[1] * values[0]) / (values[1] - values[0])
        # close to either end the step would be rounding
        s = float(np.clip(s, 1e-3 * whole, (1 - 1e-3) * whole))
        trial = _state_at(loading, prepared, first, s, newton)
        if trial is None:
            break
        value = test(trial)
        if abs(value) < best:
            state, best = trial, abs(value)
        if best <= goal:
            break
        k = 0 if value * values[0] > 0 else 1
        at[k], values[k] = s, value
        if side == k + 1:
            values[1 - k] /= 2
        side = k + 1
    if state is None:
        return None
    here = loading.at(state.factor)
    number = max(1, 1 + min(ends[0].negative_eigenvalues, ends[1].negative_eigenvalues))
    modes = tangent_modes(here, jnp.asarray(state.u), number)
    shape = modes.shapes[int(np.argmin(np.abs(modes.eigenvalues)))]
    return CriticalPoint(
        kind,
        jnp.asarray(state.factor),
        jnp.asarray(state.u),
        shape / jnp.max(jnp.abs(shape)),
        number - 1,
    )


def _state_at(loading, prepared, first: PathState, s: float, newton) -> PathState | None:
    found = arc_step(loading, prepared, first, s, newton)
    if found.reason:
        return None
    return tangent_state(
        loading, prepared, found.u, found.y[0], first.direction, found.linearised
    )


# Paths of equilibria over limit points and through bifurcations


Until = Callable[[np.ndarray, float], bool]
_EASY = 4  # iterations of a step of the right length
_SHARPEST = 0.5  # cosine of the turn between two states
_RESOLVED = 4  # cuts after which a turn is one of the path, not of the step


@displayed
class Continuation(Path):
    """A path over limit points: `factors` of the load, which are the `values` too where all
    loads grow together, and `negative_eigenvalues`, how many the tangent has (0 where stable,
    -1 unknown). `critical_points` were found on the way; `length` is that of the last step and
    `end` where the next would begin."""

    factors: Float[Array, " states"] = eqx.field(kw_only=True)
    negative_eigenvalues: Int[Array, " states"] = eqx.field(kw_only=True)
    critical_points: tuple[CriticalPoint, ...] = eqx.field(kw_only=True)
    length: float = eqx.field(static=True, kw_only=True)
    end: PathState = eqx.field(kw_only=True)

    def _text(self) -> str:
        return (
            f"Continuation: {len(self)} states, {outcome(self.status)}\n"
            f"  load factor {number(self.factors)}, {len(self.critical_points)} critical "
            f"points, negative eigenvalues {number(self.negative_eigenvalues)}"
        )


def continuation(
    problem: Problem,
    name: str | None = None,
    *,
    step: float = 0.1,
    largest_step: float | None = None,
    max_states: int = 200,
    until: Until | None = None,
    start: Continuation | CriticalPoint | None = None,
    newton: Newton | None = None,
    max_cuts: int = 10,
    locate_critical_points: bool = True,
) -> Continuation:
    """The path of equilibria under a growing load or a support that moves, by arc-length steps.

    A step has a given length of displacement; the load factor is an unknown. So where the load
    has a maximum the path goes on down, through unstable states too; where the displacement of
    a support has one, the path goes on back (snap-back). The last state is where
    `until` first holds. Runs on the host with concrete numbers; it has no derivative.

    Args:
        problem: Its loads and supports at factor one.
        name: The load that grows, or the support that moves (`Prescribed`, `Rotated`), from
            zero while the others keep their values; all loads and supports by default.
        step: Load factor of the first step [-]; later ones follow the iterations.
        largest_step: Largest movement of a node between two states [m]; no limit by default.
        max_states: States at most, the first included.
        until: Says from displacement [m] and load factor whether to stop; by default at the
            first state at or beyond the full load.
        start: A path to go on with, or one of its critical points: a bifurcation is left
            along its mode, in the opposite direction if `step` is negative. At rest by
            default.
        newton: Tolerances; `Newton()` by default.
        max_cuts: How often a step may be halved in a row.
        locate_critical_points: Find limit points and bifurcations between states.

    Returns:
        Displacements [m], load factors, stability and critical points along the path; its
        `status` says whether it was stopped by a step that failed.

    Raises:
        ValueError: If no load or moved support has that name, or a step is zero or not finite.

    Example:
        >>> bar = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1),
        ...                      element=mesh.Quad9())
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1000)
        >>> problem = fem.problem(
        ...     bar, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...     supports=(fem.Fixed(bar.node_sets["left"]),),
        ...     loads=(fem.Force(bar.node_sets["right"], [0, -0.02], name="push"),))
        >>> path = fem.continuation(problem, step=0.5)
        >>> bool(path.factors[-1] >= 1), path.negative_eigenvalues.tolist()[-1]
        (True, 0)

    Reference:
        Riks, An incremental approach to the solution of snapping and buckling problems, Int. J.
        Solids Structures 15, 1979; Crisfield, Comput. Struct. 13, 1981.
    """
    where = "fem.continuation"
    loading = Loading(where, problem, name)
    no_peaks(where, problem.material)
    _check.finite(where, "step", step, "A tenth of the load is a good start.")
    _check.positive(where, "abs(step)", abs(step), "", "A tenth of the load is a good start.")
    if largest_step is not None:
        _check.positive(where, "largest_step", largest_step, "m", "Give a length.")
    until = (lambda u, factor: factor >= 1.0) if until is None else until
    newton = Newton() if newton is None else newton
    walk = _Walk(loading, prepare(problem), newton, largest_step, max_cuts)
    walk.begin(start, step)
    while not walk.reason and walk.wants_more(max_states, until):
        if walk.step() and locate_critical_points:
            walk.locate()
        report(
            "continuation",
            len(walk.states),
            max_states,
            factor=walk.states[-1].factor,
            negative=walk.states[-1].negative_eigenvalues,
            cuts=walk.cuts,
        )
    report("continuation", 1, 1, factor=walk.states[-1].factor)
    return walk.result()


class _Walk:
    """A path that is being followed, on the host."""

    def __init__(self, loading, prepared: Prepared, newton, largest_step, max_cuts: int):
        self.loading, self.prepared, self.newton = loading, prepared, newton
        self.largest_step, self.max_cuts = largest_step, max_cuts
        self.states: list[PathState] = []
        self.steps: list[LoadStep] = []
        self.critical: list[CriticalPoint] = []
        self.cuts, self.reason = 0, ""

    def begin(self, start, step: float) -> None:
        """The first state and the length of the first step."""
        if isinstance(start, Continuation):
            self.states.append(start.end)
            self.length = start.length
        elif isinstance(start, CriticalPoint):
            u, shape = np.asarray(start.displacement), np.asarray(start.shape)
            direction = np.sign(step) * shape / np.linalg.norm(shape)
            size = float(np.linalg.norm(u)) / max(abs(float(start.factor)), 1e-300)
            self.length = abs(step) * size
            self.states.append(
                PathState(u, float(start.factor), direction, direction, 0.0, start.negative)
            )
        else:
            self._begin_at_rest(step)

    def _begin_at_rest(self, step: float) -> None:
        log = Log(self.newton, 1, self.max_cuts)
        u = follow(self.loading.rest, at_rest(self.loading.rest), log)
        found = None if log.reason else tangent_state(self.loading, self.prepared, u, 0.0)
        if found is None:
            self.reason = log.reason or "the tangent is singular, or the load does nothing"
            found = PathState(u, 0.0, 0 * u, 0 * u, 0.0, -1)
        if step < 0:
            found = found._replace(direction=-found.direction, slope=-found.slope)
        self.states.append(found)
        self.length = abs(step) * float(np.linalg.norm(found.rate))

    def wants_more(self, max_states: int, until: Until) -> bool:
        last = self.states[-1]
        moved = len(self.states) > 1
        return len(self.states) < max_states and not (moved and until(last.u, last.factor))

    def step(self) -> bool:
        """One accepted state more, or a reason why there is none."""
        failures = 0
        while True:
            self._limit_length()
            here = self.states[-1]
            found = arc_step(self.loading, self.prepared, here, self.length, self.newton)
            state, reason = None, found.reason
            if not reason:
                state = tangent_state(
                    self.loading,
                    self.prepared,
                    found.u,
                    found.y[0],
                    here.direction,
                    found.linearised,
                )
                reason = "" if state is not None else "the tangent is singular"
            if state is not None and self._turns(here, state) and failures < _RESOLVED:
                state = None
            if state is not None:
                self._accept(state, found)
                return True
            failures += 1
            self.cuts += 1
            if failures > self.max_cuts:
                self.reason = reason
                return False
            self.length /= 2

    def _limit_length(self) -> None:
        if self.largest_step is not None:
            most = self.largest_step / float(np.abs(self.states[-1].direction).max())
            self.length = min(self.length, most)

    def _turns(self, here: PathState, state: PathState) -> bool:
        """Whether the path bends too much for one step; a branch may leave at any angle."""
        leaves = here.slope == 0.0 and len(self.states) == 1
        return not leaves and float(np.sum(here.direction * state.direction)) < _SHARPEST

    def _accept(self, state: PathState, found) -> None:
        self.states.append(state)
        self.steps.append(
            LoadStep(state.factor, found.iterations, found.residual, state.negative_eigenvalues)
        )
        self.length *= float(np.clip((_EASY / max(found.iterations, 1)) ** 0.5, 0.5, 1.5))

    def locate(self) -> None:
        """Critical points between the last two states."""
        self.critical += locate(
            self.loading, self.prepared, self.states[-2], self.states[-1], self.newton
        )

    def result(self) -> Continuation:
        status = Status.not_converged if self.reason else Status.successful
        name, problem = self.loading.name, self.loading.full
        factors = jnp.asarray([s.factor for s in self.states])
        values = factors
        if name is not None:
            values = jnp.tensordot(factors, self.loading.value(problem), axes=0)
        return Continuation(
            problem,
            jnp.stack([jnp.asarray(s.u) for s in self.states]),
            values,
            name,
            status,
            Stats(tuple(self.steps), self.cuts, self.reason),
            factors=factors,
            negative_eigenvalues=jnp.asarray([s.negative_eigenvalues for s in self.states]),
            critical_points=tuple(self.critical),
            length=self.length,
            end=self.states[-1],
        )
