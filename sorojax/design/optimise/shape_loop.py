"""Optimisation of the dimensions of a drawing: nodes follow them, the mesh is built anew when
it has to be, and the memory of the optimiser goes on.
"""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, PyTree

from sorojax._jax.trace_state import is_traced
from sorojax._types import real
from sorojax.design.optimise.minimise import DesignStep, Optimised, Optimiser, minimise
from sorojax.fem import Problem
from sorojax.math.status import Status
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.motion.move import move
from sorojax.mesh.plane.triangulate import triangulate
from sorojax.mesh.quality import distortion
from sorojax.mesh.solid.tetrahedralise import tetrahedralise
from sorojax.sdf.base import AbstractSdf

Drawing = AbstractSdf | tuple[AbstractSdf, ...]


class ShapeStep(eqx.Module):
    """One step, as `on_step` sees it; also what `minimise_shape` starts again from.

    Attributes:
        step: Of the optimiser.
        meshed: Dimensions at which the mesh was built; it moves from there.
        num_meshes: Meshes built so far.
        remeshed: Whether this step built one.
    """

    step: DesignStep
    meshed: PyTree
    num_meshes: int = eqx.field(static=True)
    remeshed: bool = eqx.field(static=True)


class OptimisedShape(eqx.Module):
    """Where the optimisation of a shape ended.

    Attributes:
        optimised: Dimensions, objective, constraints, status and history.
        problem: The problem at these dimensions.
        num_meshes: Meshes built, the first one included.
        remeshed: Steps after which one was built.
        last: The last step; pass it as `resume` to go on.
    """

    optimised: Optimised
    problem: Problem
    num_meshes: int
    remeshed: tuple[int, ...]
    last: ShapeStep

    @property
    def design(self) -> PyTree:
        """The dimensions."""
        return self.optimised.design

    @property
    def objective(self) -> Float[Array, ""]:
        return self.optimised.objective

    @property
    def status(self) -> Status:
        return self.optimised.status

    @property
    def history(self) -> dict[str, np.ndarray]:
        return self.optimised.history


def minimise_shape(
    loss: Callable[[Problem, PyTree], Float[Array, ""]],
    start: PyTree,
    drawing: Callable[[PyTree], Drawing],
    build: Callable[[Mesh], Problem],
    *,
    size: float | None = None,
    order: int = 2,
    mesher: Callable[[Drawing], Mesh] | None = None,
    constraints: Sequence[Callable[[Problem, PyTree], Float[Array, "..."]]] = (),
    optimiser: Optimiser | None = None,
    steps: int = 50,
    tolerance: float = 1e-3,
    scale: float | None = None,
    on_step: Callable[[ShapeStep], None] | None = None,
    resume: ShapeStep | None = None,
) -> OptimisedShape:
    """The dimensions of a drawing at which a number of an equilibrium is least.

    The cells stay while nodes follow the drawing (`mesh.move`), so the derivative is exact,
    at the cost of one more back-substitution. After a step that spoils a cell, or goes farther
    than the nodes can follow, the new shape is meshed; the memory of the optimiser belongs to
    the dimensions and goes on.

    Args:
        loss: From the problem with moved nodes, and the dimensions, to a number: of an
            equilibrium, a path, modes of vibration or a closed loop.
        start: First dimensions, a pytree of floating-point arrays, lengths in [m].
        drawing: From dimensions to the shape, or to a tuple of it and its interfaces.
        build: From a mesh to the problem; called anew for every mesh.
        size: Wanted length of the sides [m].
        order: Degree of the cells.
        mesher: In place of `size` and `order`: from what `drawing` returns to a mesh.
        constraints: Functions like the loss, numbers or vectors, <= 0 where allowed; none by
            default.
        optimiser: As in `minimise`; `MMA()` by default, whose variables lie between 0 and 1.
        steps: Most steps.
        tolerance: Largest change of a dimension at which to stop, in its unit.
        scale: What the objective is divided by for MMA, in its unit; its size at the start by
            default.
        on_step: Called after every step: pictures, checkpoints. Nothing by default.
        resume: A step to go on from; gives the bits of the run that was not stopped.

    Returns:
        Dimensions, objective, `status`, history, and the problem at these dimensions.

    Raises:
        ValueError: If neither `size` nor `mesher` is given, or as `minimise` and the mesher.

    Example:
        >>> def cells(drawing):
        ...     return mesh.rectangle([0, 0], drawing.upper, divisions=(4, 1), order=2)
        >>> def build(bar):  # held on its left
        ...     rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45)
        ...     return fem.problem(bar, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...                        supports=(fem.Fixed(bar.node_sets["left"]),))
        >>> def volume(problem, height):  # [cm^3]
        ...     return 1e6 * 10 * mm * mesh.cell_areas(problem.mesh).sum()
        >>> found = design.minimise_shape(
        ...     volume, jnp.array(14 * mm), lambda h: sdf.Rectangle([0, 0], [40 * mm, h]),
        ...     build, mesher=cells, optimiser=design.MMA(10 * mm, 15 * mm), steps=6,
        ...     constraints=(lambda problem, h: 5 - volume(problem, h),), tolerance=1e-5)
        >>> print(f"{float(found.design) / mm:.1f} mm")
        12.5 mm
    """
    if (size is None) == (mesher is None):
        raise ValueError(
            "minimise_shape: need `size` or `mesher`, one of them. Give the length of sides."
        )
    follower = _Follower(drawing, build, mesher or _mesher(size, order))
    start = jax.tree.map(real, start)
    if resume is None:
        follower.mesh_at(start)
    else:
        follower.mesh_at(resume.meshed)
        follower.num_meshes = resume.num_meshes
        follower.prepare(resume.step.design)
    remeshed, last = [], resume

    def moved(function):
        return lambda p: function(follower.problem(p), p)

    def after(step: DesignStep):
        nonlocal last
        new = follower.prepare(step.design)
        if new:
            remeshed.append(step.count)
        last = ShapeStep(step, follower.meshed, follower.num_meshes, new)
        if on_step is not None:
            on_step(last)

    found = minimise(
        moved(loss),
        start,
        constraints=tuple(map(moved, constraints)),
        optimiser=optimiser,
        steps=steps,
        tolerance=tolerance,
        scale=scale,
        on_step=after,
        resume=None if resume is None else resume.step,
    )
    assert last is not None
    return OptimisedShape(
        found, follower.problem(found.design), follower.num_meshes, tuple(remeshed), last
    )


def _mesher(size, order: int) -> Callable[[Drawing], Mesh]:
    def fill(drawing: Drawing) -> Mesh:
        shape, interfaces = _fields(drawing)
        make = triangulate if shape.dim == 2 else tetrahedralise
        return make(shape, size=size, order=order, interfaces=interfaces)

    return fill


def _fields(drawing: Drawing) -> tuple[AbstractSdf, tuple[AbstractSdf, ...]]:
    fields = drawing if isinstance(drawing, tuple) else (drawing,)
    return fields[0], tuple(fields[1:])


class _Follower:
    """The mesh of a drawing and the problem on it, moved along or built anew."""

    def __init__(self, drawing, build, mesher):
        self.drawing, self.build, self.mesher = drawing, build, mesher
        self.num_meshes = 0
        self.meshed: Any = None

    def mesh_at(self, parameters: PyTree) -> None:
        self.base = self.build(self.mesher(self.drawing(parameters)))
        self.meshed = parameters
        self.num_meshes += 1

    def prepare(self, parameters: PyTree) -> bool:
        """See that the mesh follows to concrete `parameters`; whether a new one was built."""
        if self._follows(parameters):
            return False
        self.mesh_at(parameters)
        return True

    def problem(self, parameters: PyTree) -> Problem:
        """The problem with nodes moved to `parameters`; differentiable in them."""
        if not is_traced(parameters):
            self.prepare(parameters)
        return followed(self.base, self.drawing(parameters))

    def _follows(self, parameters: PyTree) -> bool:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                moved = followed(self.base, self.drawing(parameters))
            except (ValueError, UserWarning) as error:
                if not str(error).startswith("move:"):
                    raise
                return False
        return not bool(distortion(self.base.mesh, moved.mesh).remesh)


def followed(
    problem: Problem, drawing: Drawing, before: Drawing | None = None, stages: int = 4
) -> Problem:
    """`problem` on its mesh with nodes moved to `drawing`, as `mesh.move`; differentiable in
    the drawing."""
    shape, interfaces = _fields(drawing)
    way = {"interfaces": interfaces, "before": before, "stages": stages}
    points = move(problem.mesh, shape, **way).points
    return eqx.tree_at(lambda p: p.mesh.points, problem, points)
