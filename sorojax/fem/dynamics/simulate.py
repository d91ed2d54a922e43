"""`simulate`: motion of a body in time, with its loads and supports as functions of time."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.jit import once
from sorojax._jax.trace_state import is_traced
from sorojax._progress import report
from sorojax._types import real
from sorojax.fem.contact.obstacle import Contact, moving
from sorojax.fem.dynamics.damping import AbstractDamping
from sorojax.fem.dynamics.host import Control, Run, compiled_matter
from sorojax.fem.dynamics.implicit_diff import MotionCall, recorded, replay
from sorojax.fem.dynamics.masses import swing_force, with_masses
from sorojax.fem.dynamics.methods import AbstractMethod, GeneralisedAlpha
from sorojax.fem.dynamics.step import (
    Dynamics,
    Mass,
    Matter,
    State,
    StepState,
    damping_matrix,
    loads_at,
)
from sorojax.fem.dynamics.trajectory import Trajectory
from sorojax.fem.equilibrium.jit import known_mask
from sorojax.fem.equilibrium.newton import Newton
from sorojax.fem.loads.loads import AbstractLoad, remembers
from sorojax.fem.problem import Problem, body, exchanged, residual
from sorojax.fem.relaxation import first_peaks, relaxed
from sorojax.math.linalg import sparse
from sorojax.math.status import Status
from sorojax.mesh.mesh import Mesh

History = Callable[[Float[Array, ""]], Array] | Float[Array, "grid ..."]
Start = Trajectory | State | tuple[Float[Array, "nodes dim"], Float[Array, "nodes dim"]]


class MotionError(RuntimeError):
    """A motion could not go on; `motion` holds what was reached."""

    def __init__(self, message: str, motion: Trajectory):
        super().__init__(message)
        self.motion = motion

    def __reduce__(self):
        return type(self), (str(self), self.motion)


def simulate(
    problem: Problem,
    duration: float,
    step: float,
    *,
    start: Start | None = None,
    method: AbstractMethod | None = None,
    damping: AbstractDamping | tuple[AbstractDamping, ...] = (),
    mass: Mass = "consistent",
    save: int | None = None,
    adaptive: bool | float = False,
    newton: Newton | None = None,
    max_cuts: int = 14,
    max_steps: int | None = None,
    throw: bool = True,
    **histories: History,
) -> Trajectory:
    """Motion of a body in time: M u'' + C u' + f_int(u) = f_ext(t).

    Implicit steps of second order (generalised-alpha by default). Every step is the equilibrium
    of the body with its inertia and damping, found by Newton's method; one that does not
    converge, would invert a cell or takes a point through the obstacle of a `Contact` is
    halved, and steps grow again afterwards. The branches of a `material.Viscoelastic` relax on
    the way, at first relaxed at the displacement that the motion begins with; every saved
    state holds what they remember.

    Args:
        problem: What moves; its material needs a density.
        duration: How long [s].
        step: Size of the steps [s], shortened a little so that they divide `duration`.
        start: A motion or its `end` to go on from, or displacement [m] and velocity [m/s];
            at rest without displacement by default.
        method: `GeneralisedAlpha(rho_inf)`, `Newmark(beta, gamma)` or `EnergyMomentum()`;
            `GeneralisedAlpha(0.5)` by default.
        damping: `Rayleigh(...)`, `KelvinVoigt(...)` or several of them; none by default.
        mass: "consistent", or "lumped" on the diagonal.
        save: Number of saved states, both ends included; every step's by default.
        adaptive: Halve steps also where their estimated error is more than this share of
            the largest displacement [-]; `True` is 1e-3.
        newton: Tolerances; `Newton()` by default.
        max_cuts: How often a step may be halved in a row.
        max_steps: Accepted steps at most; by default 256 times as many as `duration` / `step`.
            Inside a trace, where memory is reserved for them, 64 more than asked for, and 16
            times as many with `adaptive`.
        throw: Raise when a run outside a trace fails, otherwise report it in `status`.
        **histories: Values of loads and of prescribed supports by name, in their units:
            functions of time [s] or arrays with one value for each end of a step. They are
            taken at the ends of the steps and linear between them.

    Returns:
        States at the saved times, their energies, and how the run ended.

    Raises:
        MotionError: If `throw` and a step failed after all cuts.
        ValueError: If a name, a shape or a number does not fit.

    Example:
        >>> bar = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1),
        ...                      element=mesh.Quad9())
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1000)
        >>> problem = fem.problem(
        ...     bar, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...     supports=(fem.Fixed(bar.node_sets["left"]),), loads=(fem.Gravity(),))
        >>> motion = fem.simulate(problem, duration=0.02, step=5e-3)
        >>> print(f"{float(motion.displacements[-1, :, 1].min()) / mm:.2f} mm")
        -0.58 mm

    Reference:
        Chung and Hulbert, A time integration algorithm for structural dynamics with improved
        numerical dissipation: the generalized-alpha method, J. Appl. Mech. 60, 1993.
    """
    where = "fem.simulate"
    _check.positive(where, "duration", duration, "s", "Give how long to simulate.")
    _check.positive(where, "step", step, "s", "Take 1/50 of the period of interest.")
    if mass not in ("consistent", "lumped"):
        raise ValueError(f"{where}: got mass={mass!r}, need 'consistent' or 'lumped'.")
    grid, every = _grid(where, duration, step, save)
    size = real(duration) / grid
    damping = (damping,) if isinstance(damping, AbstractDamping) else tuple(damping)
    for term in damping:
        term.check(problem)
    method = GeneralisedAlpha() if method is None else method
    begin = _begin_time(start)
    times = begin + size * jnp.arange(grid + 1, dtype=size.dtype)
    loads, supports = _rows(where, problem, histories, times)
    scheme, rest = method.coefficients(), _rest(problem, loads)
    dynamics = Dynamics(
        problem, damping, scheme, loads, supports, rest, size, mass, method.conserves
    )
    begun = _state(where, dynamics, start)
    # tangent and lists are no part of the motion, only of how it is computed
    bare = dataclasses.replace(begun, tangent=None, listed=None)
    dynamics = dataclasses.replace(dynamics, start=bare)
    error = (1e-3 if adaptive is True else float(adaptive)) if adaptive else None
    traced = is_traced((dynamics, jnp.zeros(())))
    if max_steps is None and traced:
        max_steps = grid + 64 if error is None else 16 * grid
    max_steps = 256 * grid if max_steps is None else max_steps
    newton = Newton() if newton is None else newton
    control = Control(newton, max_cuts, error, max_steps)
    if traced:
        return _in_trace(dynamics, control, grid, every)
    motion = _on_host(dynamics, control, grid, every, begun)
    if throw and motion.stats.reason:
        raise MotionError(
            f"{where}: no step beyond {float(motion.end.time):.6g} s after "
            f"{motion.stats.cuts} cuts ({motion.stats.reason}). Take shorter steps, lower the "
            "load, or pass throw=False for the motion up to there.",
            motion,
        )
    return motion


def _on_host(
    dynamics: Dynamics, control: Control, grid: int, every: int, begun: State
) -> Trajectory:
    run = Run(dynamics, control)
    run.resume(begun)
    states, points = [run.now], [0]
    for index in range(grid):
        if not run.advance(index):
            break
        if (index + 1) % every == 0:
            states.append(run.now)
            points.append(index + 1)
        report("motion", index + 1, grid, iterations=run.iterations, cuts=run.cuts)

    def column(first, *others):
        if not eqx.is_inexact_array(first):
            return first
        return jnp.asarray(np.stack([np.asarray(x) for x in (first, *others)]))

    stacked = jax.tree.map(column, *states).whole()
    at = jnp.asarray(points, jnp.int32)
    stats = run.stats()
    counts = (jnp.asarray(n) for n in (stats.steps, stats.iterations, stats.cuts))
    return Trajectory(dynamics, stacked, at, run.end(), run.status, *counts, stats)


def _in_trace(dynamics: Dynamics, control: Control, grid: int, every: int) -> Trajectory:
    record = recorded(MotionCall(dynamics, control, grid, control.max_steps))
    states, end = replay(dynamics, record, grid, every)
    at = jnp.arange(0, grid + 1, every, dtype=jnp.int32)
    failed, *counts = (record.counts[k] for k in range(4))
    status = Status.where(failed != 0, Status.not_converged, Status.successful)
    counts = (jax.lax.stop_gradient(n).astype(int) for n in counts)
    return Trajectory(dynamics, states, at, end, status, *counts, None)


def _grid(where: str, duration, step, save: int | None) -> tuple[int, int]:
    """Number of steps, and of those between two saved states."""
    if is_traced((duration, step)):
        raise ValueError(
            f"{where}: `duration` and `step` fix the number of steps and cannot be traced. "
            "Pass Python numbers."
        )
    wanted = float(duration) / float(step)
    if save is None:
        return max(1, int(np.ceil(wanted * (1 - 1e-9)))), 1
    if save < 2:
        raise ValueError(f"{where}: `save` must be 2 or more, got {save}.")
    every = max(1, int(np.ceil(wanted / (save - 1) * (1 - 1e-9))))
    return every * (save - 1), every


def _begin_time(start: Start | None):
    if isinstance(start, Trajectory):
        start = start.end
    return start.time if isinstance(start, State) else jnp.zeros((), jnp.result_type(float))


def _rest(problem: Problem, rows: tuple[Array | None, ...]) -> State:
    zero = jnp.zeros_like(problem.mesh.points)
    none = jnp.zeros((), zero.dtype)
    first = zip(problem.loads, rows, strict=True)
    memory = tuple(
        _placed(load, row, problem.mesh).in_motion(problem) if remembers(load) else None
        for load, row in first
    )
    kept = _remembered(problem, zero)
    return State(none, zero, zero, zero, memory, none, none, jnp.ones_like(none), **kept)


def _remembered(problem: Problem, u: Array) -> dict[str, Array | None]:
    """What a body remembers that a motion begins with at displacement `u` [m]."""
    return {"strains": relaxed(body(problem), u), "peaks": first_peaks(body(problem), u)}


def _placed(load: AbstractLoad, row: Array | None, mesh: Mesh) -> AbstractLoad:
    """`load` with its obstacle where the motion begins, unless friction holds on to it."""
    if not isinstance(load, Contact):
        return load
    place = load.value if row is None else row[0]
    if load.grip is not None and load.place is not None:
        place = jnp.where(jnp.any(load.grip.pressure > 0), load.place, place)
    return moving(load, mesh, place)


def _state(where: str, dynamics: Dynamics, start: Start | None) -> State:
    """The state to start from, with the acceleration that balances it."""
    if isinstance(start, Trajectory):
        start = start.end
    if isinstance(start, State):
        for kept, word in (("strains", "is viscoelastic"), ("peaks", "softens")):
            if (getattr(start, kept) is None) == (getattr(dynamics.start, kept) is None):
                continue
            raise ValueError(
                f"{where}: got the `start` of a body that {word} and a problem that does "
                "not, or the reverse, need the same. Give (displacement, velocity), to "
                "begin relaxed."
            )
        return start
    state = dynamics.start
    if start is not None:
        u, v = (real(x) for x in start)
        for name, x in (("displacement", u), ("velocity", v)):
            _check.shape(
                where,
                f"start {name}",
                x,
                dynamics.problem.mesh.points.shape,
                "Give one vector per node.",
            )
            _check.finite(where, f"start {name}", x, "Use SI units.")
        kept = _remembered(dynamics.problem, u)
        state = dataclasses.replace(state, displacement=u, velocity=v, **kept)
    return eqx.tree_at(lambda s: s.acceleration, state, _acceleration(dynamics, state))


def _acceleration(dynamics: Dynamics, state: State) -> Float[Array, "nodes dim"]:
    """Acceleration [m/s^2] that balances a state."""
    matrix, rhs = _balance(dynamics, compiled_matter(dynamics), state)
    system = dynamics.problem.space.system
    if is_traced((matrix, rhs)):
        a = sparse.solve(system, matrix, rhs)
    else:
        a = jnp.asarray(system.solver.solve(np.asarray(matrix), np.asarray(rhs)))
    return a.reshape(state.displacement.shape)


@once
def _balance(dynamics: Dynamics, known: Matter, state: State):
    problem, u = dynamics.problem, state.displacement
    none = jnp.zeros((), u.dtype)
    rest = StepState(u, state.velocity, u, none, u, state.time, none)
    bare = body(problem)
    loads = loads_at(dynamics, state, lambda row: row[0])
    loads = tuple(load.begun(bare, rest) for load in loads)
    force = -residual(exchanged(problem, loads=loads), u).ravel()
    damping = damping_matrix(dynamics, known, u)
    if damping is not None:
        v = state.velocity.ravel()
        force = force - sparse.product(problem.space.system, damping, v)
    force = force - swing_force(problem, u, state.velocity).ravel()
    mask = known_mask(problem.supports, *u.shape)
    mass = with_masses(problem, u, known.mass)
    matrix = sparse.fix(problem.space.system, mass, mask)
    return matrix, jnp.where(mask, jnp.zeros_like(force), force)


def _rows(where: str, problem: Problem, histories: dict[str, Any], times):
    """Values on the grid of times for the loads and supports that are named."""
    loads = [load.name for load in problem.loads]
    moving = [s.name if s.ramped is not None else None for s in problem.supports]
    names = [*loads, *(name for name in moving if name is not None)]
    if unknown := sorted(set(histories) - set(names)):
        raise ValueError(
            f"{where}: got values for {unknown}, need some of {sorted(set(names))}. Name a "
            "load or a support with `name=`."
        )

    def row(name, want):
        if name not in histories:
            return None
        given: Any = histories[name]
        follow = jax.vmap(lambda t: real(given(t)))  # pyright: ignore[reportArgumentType]
        values = follow(times) if callable(given) else real(given)
        _check.shape(
            where,
            name,
            values,
            (times.shape[0], *want),
            "Give a function of time, or a value for each end of a step.",
        )
        _check.finite(where, name, values, "Use SI units.")
        return values

    return (
        tuple(row(load.name, load.value.shape) for load in problem.loads),
        tuple(
            None if s.ramped is None else row(s.name, getattr(s, s.ramped).shape)
            for s in problem.supports
        ),
    )
