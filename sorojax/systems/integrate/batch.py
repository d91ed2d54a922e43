"""Many members of one network at once, stiff ones apart, broken ones alone."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from sorojax import _check
from sorojax._types import real
from sorojax.math.host import tell
from sorojax.math.ode.explicit import Tsit5
from sorojax.math.ode.rosenbrock import Rodas4
from sorojax.math.ode.step_control import Control
from sorojax.math.status import Status
from sorojax.systems.integrate.integrate import Integration, adaptive
from sorojax.systems.integrate.simulate import Trajectory, film_of, instants
from sorojax.systems.network import Network

_PILOTS = 4  # members that show what the others need


def simulate_batch(
    make: Callable[[Any], Network],
    designs: PyTree,
    duration: float | Float[Array, ""],
    *,
    inputs: Mapping[str, Any] | None = None,
    save: int = 201,
    rtol: Any = 1e-6,
    atol: Any = 1e-8,
    max_step: float | Float[Array, ""] | None = None,
    cheap_steps: int = 4000,
    max_steps: int = 200_000,
    solver: dfx.AbstractSolver | None = None,
    stiff_solver: dfx.AbstractSolver | None = None,
    adjoint: dfx.AbstractAdjoint | None = None,
    devices: Sequence[Any] | None = None,
    progress: bool = False,
) -> Trajectory:
    """Time simulation of `make(design)` for many designs at once, differentiable in them.

    All members run together by an explicit method with a cap on its steps, an eighth more
    than what four pilot members take. Members that reach it run again, one by one, by a stiff
    method. A member that fails holds its last good state, has its own status and counters and
    the gradient zero; the others are unchanged, in value and in gradient.

    Args:
        make: A function of one design that gives the network.
        designs: A pytree of arrays with a leading axis of members.
        duration: How long [s].
        inputs: Values or references for the exposed inputs of all members, in the units of
            their ports.
        save: Number of saved instants, both ends included.
        rtol: Relative tolerance [-], as in `simulate`.
        atol: Absolute tolerance, in the unit of each state, as in `simulate`.
        max_step: Longest step [s]; no limit by default.
        cheap_steps: Limit of steps of the explicit method, also for the pilots.
        max_steps: Limit of steps of the stiff method.
        solver: Explicit method; `Tsit5()` by default.
        stiff_solver: Stiff method; `Rodas4()` by default.
        adjoint: As in `simulate`.
        devices: Share the members among these devices; their number divides that of the
            members. One device by default.
        progress: Report progress while running: how far all members are on average, then how
            many of them have been checked for the stiff method.

    Returns:
        A trajectory whose arrays, status and stats have a leading axis of members; the
        stats say in `stiff` which ran again.

    Raises:
        ValueError: If the designs have no common leading axis, or the devices do not divide
            it.

    Example:
        >>> def valve(time):
        ...     return systems.Network({"valve": systems.Lag(time)}, {}, exposed=("valve.a",))
        >>> runs = systems.simulate_batch(valve, jnp.array([0.1, 0.2]), 0.2, save=2,
        ...                               inputs={"valve.a": 1.0})
        >>> runs["valve.value"][:, -1].round(3).tolist()  # 1 - exp(-2), 1 - exp(-1)
        [0.865, 0.632]
    """
    _check.positive("simulate_batch", "duration", duration, "s", "Give the end time.")
    designs = jax.tree.map(real, designs)
    counts = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(designs)}
    if len(counts) != 1 or counts == {()}:
        raise ValueError(
            f"simulate_batch: the leaves of `designs` have the leading axes {sorted(counts)}, "
            "need one axis of members. Give arrays of one length."
        )
    (members,) = counts.pop()
    supplied = {k: v if callable(v) else real(v) for k, v in (inputs or {}).items()}
    control = Control(rtol, atol, max_step=max_step)
    solvers = (solver or Tsit5(), stiff_solver or Rodas4())
    limits = (save, cheap_steps, max_steps, progress)
    run = (make, supplied, real(duration), control, solvers, adjoint, limits)
    if devices is None:
        return _whole(run, designs)
    if members % len(devices):
        raise ValueError(
            f"simulate_batch: {members} members cannot be shared among {len(devices)} "
            "devices. Pad the designs to a multiple, or give fewer devices."
        )
    return _shared(run, designs, tuple(devices))


@eqx.filter_jit
def _shared(run, designs, devices) -> Trajectory:
    mesh = jax.sharding.Mesh(np.array(devices), ("members",))
    split, whole = jax.P("members"), jax.P()
    arrays, static = eqx.partition(run, eqx.is_array)

    def part(arrays, designs):
        film = _two_passes(eqx.combine(arrays, static), designs)
        return eqx.filter(film, eqx.is_array)

    shape = eqx.filter_eval_shape(lambda d: _two_passes(run, d), designs)
    shard = jax.shard_map(
        part, mesh=mesh, in_specs=(whole, split), out_specs=split, check_vma=False
    )
    rest = eqx.filter(shape, lambda leaf: not isinstance(leaf, jax.ShapeDtypeStruct))
    return eqx.combine(shard(arrays, designs), rest)


def _two_passes(run, designs) -> Trajectory:
    make, inputs, duration, control, (cheap, stiff), adjoint, limits = run
    save, cheap_steps, max_steps, progress = limits
    zero = jnp.zeros((), jnp.int32)
    time = instants(zero, duration / (save - 1), save)

    def go(design, solver, control, most, label=None) -> Integration:
        network = make(design)
        state = network.initial_state()
        motion = adaptive(
            network,
            inputs,
            state,
            time,
            solver,
            control,
            max_steps=most,
            adjoint=adjoint,
            progress=progress and (label or False),
        )
        return motion._replace(memory=None)  # which differs between the methods

    cap = _cap(lambda design: go(design, cheap, control, cheap_steps), designs, cheap_steps)
    capped = eqx.tree_at(lambda c: c.tries, control, cap, is_leaf=lambda x: x is None)
    first = jax.vmap(lambda design: go(design, cheap, capped, cheap_steps, "batch"))(designs)
    again = first.status != Status.successful
    count = again.shape[0]

    def member(_, given):
        number, design, motion, again = given
        repeat = lambda: go(design, stiff, control, max_steps)  # noqa: E731
        motion = jax.lax.cond(again, repeat, lambda: motion)
        if progress:
            done = (number + 1) / count
            due = again | (number + 1 == count)
            jax.lax.cond(due, lambda x: tell("stiff members", x), lambda _: None, done)
        return None, motion

    motion = jax.lax.scan(member, None, (jnp.arange(count), designs, first, again))[1]
    motion = _still(motion)
    film = jax.vmap(lambda d, m: film_of(make(d), time, inputs, m))(designs, motion)
    return eqx.tree_at(lambda film: film.stats, film, film.stats | {"stiff": again})


_whole = eqx.filter_jit(_two_passes)


def _cap(go: Callable[[Any], Integration], designs: PyTree, most: int) -> Array:
    """An eighth more steps than the slowest of some members that are not stiff.

    Members march together, so every step of the slowest costs a step of all.
    """
    count = jax.tree.leaves(designs)[0].shape[0]
    some = np.unique(np.linspace(0, count - 1, min(_PILOTS, count)).astype(int))
    few = jax.lax.stop_gradient(jax.tree.map(lambda x: x[some], designs))
    used = jax.lax.stop_gradient(jax.vmap(go)(few).steps)
    median = jnp.sort(used)[(len(some) - 1) // 2]
    slowest = jnp.max(jnp.where(used <= 2 * median, used, 0))
    return jnp.minimum(9 * slowest // 8 + 10, most).astype(jnp.int32)


def _still(motion: Integration) -> Integration:
    """The motions, without derivatives where they failed."""
    good = motion.status == Status.successful

    def keep(x):
        if not jnp.issubdtype(x.dtype, jnp.inexact):
            return x
        mask = good.reshape(-1, *[1] * (x.ndim - 1))
        return jnp.where(mask, x, jax.lax.stop_gradient(x))

    path, last = jax.tree.map(keep, (motion.path, motion.last))
    return motion._replace(path=path, last=last)
