"""The optimisation loop: any differentiable function of a pytree, constraints, any method."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from sorojax import _check
from sorojax._display import displayed, number, outcome
from sorojax._progress import report
from sorojax._types import real
from sorojax.design.optimise.base import AbstractOptimiser, Values
from sorojax.design.optimise.mma import MMA
from sorojax.design.optimise.optimality import Task
from sorojax.math.status import Status
from sorojax.mesh.mesh import Mesh

Optimiser = AbstractOptimiser | optax.GradientTransformation
_HELD = 1e-3  # overshoot of a constraint that counts as none
_STUCK = 5  # small steps in a row that are no end of a search
_RETREATS = 4  # halvings of a step that leads to where a function is not defined


class DesignStep(eqx.Module):
    """One step, as `on_step` sees it; also what `minimise` starts again from.

    Attributes:
        count: Steps taken, from 1.
        design: The variables after it.
        objective, constraints: At the design before it.
        change: Largest change of a variable.
        memory: Of the optimiser.
    """

    count: int = eqx.field(static=True)
    design: PyTree
    objective: Float[Array, ""]
    constraints: Float[Array, " m"]
    change: Float[Array, ""]
    memory: Any


@displayed
class Optimised(eqx.Module):
    """Where an optimisation ended.

    Attributes:
        design: The variables.
        objective: At `design`.
        constraints: At `design`, each <= 0 if it holds.
        status: `successful` when the change fell below the tolerance, `out_of_reach` when it
            did with a constraint broken, `not_converged` when it did because the method could
            find no longer step, `max_steps` when the steps ran out first, `not_finite` when a
            value broke or the functions refused the design with an error, after shorter steps
            too; the last good design then.
        history: Objective, constraints (m columns) and change of every step.
        last: The last step; pass it as `resume` to go on.
    """

    design: PyTree
    objective: Float[Array, ""]
    constraints: Float[Array, " m"]
    status: Status
    history: dict[str, Float[np.ndarray, "steps *columns"]]
    last: DesignStep

    def _text(self) -> str:
        count = len(self.history["objective"])
        held = f", largest constraint {number(jnp.max(self.constraints))}"
        return (
            f"Optimised: {outcome(self.status)} after {count} steps, objective "
            f"{number(self.objective)}{held * bool(self.constraints.size)}"
        )


def minimise(
    loss: Callable[..., Float[Array, ""]],
    start: PyTree,
    *,
    constraints: Sequence[Callable[..., Float[Array, "..."]]] = (),
    optimiser: Optimiser | None = None,
    steps: int = 100,
    tolerance: float = 1e-3,
    schedule: Callable[[int], tuple] | None = None,
    change_gradient: Callable[[PyTree, PyTree], PyTree] | None = None,
    scale: float | None = None,
    on_step: Callable[[DesignStep], None] | None = None,
    resume: DesignStep | None = None,
) -> Optimised:
    """The design at which `loss` is least while every constraint stays at or below zero.

    min f(x) subject to g_i(x) <= 0, by the method of moving asymptotes unless another optimiser
    is given. Functions are called outside `jit`, so they may solve equilibria; jit them where
    they can be.

    Args:
        loss: Function of the design that returns a number; differentiable in it.
        start: Where to begin, a pytree of floating-point arrays in the units of the design.
        constraints: Functions of the design, numbers or vectors, <= 0 where allowed; none by
            default.
        optimiser: `MMA()` by default, whose variables lie between 0 and 1; `GCMMA`,
            `OptimalityCriteria`, another `AbstractOptimiser`, or any optax optimiser (without
            constraints).
        steps: Most steps.
        tolerance: Largest change of a variable at which to stop, in its unit; with a
            `schedule` all steps are taken.
        schedule: Further arguments of loss and constraints at step k = 0, 1, ...: for
            continuation, `lambda k: (sharpness(k),)`. None by default.
        change_gradient: Replaces the gradient of the loss, from design and gradient; the exact
            one by default.
        scale: What the objective is divided by for MMA, in its unit; its size at the start by
            default.
        on_step: Called after every step: pictures, checkpoints. Nothing by default.
        resume: A step to go on from instead of `start`.

    Returns:
        Design, objective, constraints, how the search ended and its history.

    Raises:
        ValueError: If something is not finite at the start, or an optax optimiser gets
            constraints.

    Example:
        >>> found = design.minimise(lambda x: jnp.sum((x - 0.7) ** 2), jnp.array([0.2, 0.9]),
        ...                         constraints=(lambda x: x[0] + x[1] - 1,), steps=30)
        >>> found.design.round(2).tolist()
        [0.5, 0.5]

    Reference:
        Svanberg, The method of moving asymptotes - a new method for structural optimization,
        Int. J. Numer. Meth. Engng 24, 1987.
    """
    method = MMA() if optimiser is None else optimiser
    if isinstance(method, optax.GradientTransformation):
        method = _Optax(method)
    constraints = tuple(constraints)
    _check.finite("minimise", "start", ravel_pytree(start)[0], "Check the first design.")
    flat, back = _as_vector(jax.tree.map(real, start))
    task = Task(loss, constraints, back, schedule, change_gradient)
    first, memory = 0, None
    if resume is not None:
        flat, memory, first = ravel_pytree(resume.design)[0], resume.memory, resume.count
    values, size, last, history, step, stuck = None, None, flat, [], resume, 0
    status = Status.max_steps
    for k in range(first, steps):
        values, finite = _found(task, flat, k, retry=k > first)
        for _ in range(_RETREATS if k > first else 0):
            if finite:
                break
            flat = (flat + last) / 2
            values, finite = _found(task, flat, k, retry=True)
        if values is None or not finite:
            if values is not None and k == first:
                raise ValueError(
                    f"minimise: the objective is {values.objective} and the constraints "
                    f"{values.constraints} at the first design, with "
                    f"{int(jnp.sum(~jnp.isfinite(values.gradient)))} derivatives that are not "
                    "finite. Start where the functions are defined."
                )
            status = Status.not_finite
            break
        size = real(_size(flat, values) if scale is None else scale) if size is None else size
        if memory is None:
            memory = method.init(flat, values.constraints.shape[0])
        new, memory = _advance(method, task, k, flat, values, memory, size)
        change = float(np.max(np.abs(np.asarray(new) - np.asarray(flat))))
        last, flat = flat, new
        step = DesignStep(
            k + 1, back(flat), values.objective, values.constraints, jnp.asarray(change), memory
        )
        history.append((float(values.objective), np.asarray(values.constraints), change))
        report(
            "minimise",
            k + 1,
            steps,
            objective=history[-1][0],
            change=change,
            constraint=float(np.max(history[-1][1], initial=-np.inf)),
        )
        if on_step is not None:
            on_step(step)
        stuck = stuck + 1 if change <= tolerance else 0
        if stuck and schedule is None:
            settled = method.is_settled(memory)
            if settled or stuck == _STUCK:
                status = Status.successful if settled else Status.not_converged
                break
    if status == Status.not_finite:
        flat = last
    k_last = max(len(history) + first - 1, 0)
    ends = _last(task, flat, k_last, retry=bool(history))
    if last is not None and (ends is None or not _all_finite(*ends)):
        status = Status.not_finite
        ends = task.last(flat := last, k_last)
    assert ends is not None
    objective, held = ends
    columns = _columns(history)
    if status == Status.successful and _broken(held, columns):
        status = Status.out_of_reach
    return Optimised(back(flat), objective, held, status, columns, step)  # type: ignore


def _found(task: Task, flat, k: int, retry: bool) -> tuple[Values | None, Any]:
    """Values at a design and whether they are finite; with `retry` there are none where the
    functions refuse it."""
    try:
        return task.found(flat, k)
    except (RuntimeError, ValueError) as error:
        return _refused(error, k, retry), False


def _last(task: Task, flat, k: int, retry: bool):
    try:
        return task.last(flat, k)
    except (RuntimeError, ValueError) as error:
        return _refused(error, k, retry)


def _refused(error: Exception, k: int, retry: bool) -> None:
    if not retry:
        raise error
    _check.warn(
        f"minimise: step {k} went to a design that fails: {error} A design nearer to the one "
        "before is taken. Lower `move`, or narrow the bounds."
    )


def _all_finite(objective: Array, held: Array) -> bool:
    return bool(jnp.isfinite(objective) & jnp.all(jnp.isfinite(held)))


def _broken(held: Array, columns: dict[str, np.ndarray]) -> bool:
    """Whether a constraint ends above a thousandth of its values on the way, or of one."""
    if held.size == 0:
        return False
    largest = np.abs(columns["constraints"]).max(axis=0, initial=1.0)
    return bool(np.any(np.asarray(held) > _HELD * largest))


class _Optax(AbstractOptimiser):
    """An optimiser of optax, which takes no constraints."""

    scaled: ClassVar[bool] = False
    transformation: optax.GradientTransformation = eqx.field(static=True)

    def init(self, x, constraints):
        if constraints:
            raise ValueError(
                "minimise: an optax optimiser takes no constraints. Use MMA() or GCMMA(), or "
                "add a penalty to the loss."
            )
        return self.transformation.init(x)

    def update(self, x, values, memory, evaluate):
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers and floats
            updates, memory = self.transformation.update(values.gradient, memory, x)
            return jnp.asarray(optax.apply_updates(x, updates)), memory


def _advance(method: AbstractOptimiser, task: Task, k: int, flat, values: Values, memory, size):
    if method.scaled:
        values = _scaled(values, size)

    def evaluate(x):
        objective, held = task.plain(x, k)
        return objective / size if method.scaled else objective, held

    return method.update(flat, values, memory, evaluate)


@jax.jit
def _scaled(values: Values, scale) -> Values:
    return values._replace(objective=values.objective / scale, gradient=values.gradient / scale)


def _as_vector(start: PyTree):
    """`ravel_pytree`, which takes operations even for what is a vector."""
    if isinstance(start, jax.Array) and start.ndim == 1:
        return start, lambda x: x
    return ravel_pytree(start)


def _size(flat, values: Values) -> float:
    """The size of the objective, or of what the variables contribute where it starts at 0."""
    size, change = (
        float(jnp.abs(values.objective)),
        float(jnp.abs(values.gradient) @ jnp.abs(flat)),
    )
    return (size if size > 1e-3 * change else change) or 1.0


def _columns(history) -> dict[str, np.ndarray]:
    names = ("objective", "constraints", "change")
    columns = list(zip(*history, strict=True)) or [(), (), ()]
    return {name: np.array(column) for name, column in zip(names, columns, strict=True)}


# The designs of a run, for pictures and films of it


class History:
    """The designs of a run: give it to `minimise` as `on_step`.

    `densities` has one row per kept step, beside `steps` and `objectives`. With the `mesh` of
    the cells, `view.show(history)` draws some of them and `view.animate(history)` all.

    Args:
        density: From a `DesignStep` to the densities of its design.
        every: Steps from one that is kept to the next.
        mesh: The cells.
    """

    def __init__(
        self, density: Callable[[DesignStep], Any], every: int = 1, *, mesh: Mesh | None = None
    ):
        self._density, self._every, self._mesh = density, every, mesh
        self.steps: list[int] = []
        self.objectives: list[float] = []
        self._rows: list[np.ndarray] = []

    def __call__(self, step: DesignStep) -> None:
        if (step.count - 1) % self._every:
            return
        self.steps.append(step.count)
        self.objectives.append(float(step.objective))
        self._rows.append(np.asarray(self._density(step)))

    @property
    def mesh(self) -> Mesh:
        """The cells.

        Raises:
            ValueError: If none was given.
        """
        if self._mesh is None:
            raise ValueError(
                "design.History: got no mesh, need that of the cells for a picture. Make it "
                "with mesh=."
            )
        return self._mesh

    @property
    def densities(self) -> Float[np.ndarray, "kept cells"]:
        return np.stack(self._rows) if self._rows else np.zeros((0, 0))
