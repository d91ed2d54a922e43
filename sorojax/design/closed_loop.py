"""From a drawing to the motion of its closed loop: one differentiable function.

Nodes follow the drawing, equilibria under pressure give strains of a curve, these give modes,
and the solid's condensed stiffness gives the laws of the rod that the network moves.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax._display import displayed, number, outcome
from sorojax._edit import without_derivatives
from sorojax._jax.jit import once
from sorojax._jax.trace_state import evaluated_now, is_traced
from sorojax._types import Numbers
from sorojax.design.optimise.shape_loop import Drawing, followed
from sorojax.fem import Newton, Problem, solve_path
from sorojax.fem.equilibrium.solve import Path
from sorojax.math.lie import SE2, SE3
from sorojax.math.status import Status
from sorojax.math.two_programs import two_programs
from sorojax.mesh.measure import cell_areas, cell_volumes
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.quality import distortion
from sorojax.reduction import AbstractCurve, Backbone, pod_basis
from sorojax.reduction.backbone import Probe, sampled
from sorojax.reduction.identify import Fit, identified
from sorojax.reduction.pod import RANK, weights
from sorojax.rod import AbstractModes, Elastic, Rod, StrainBasis, elastic, rod
from sorojax.systems import Network, Rodas4, RodBody, simulate
from sorojax.systems.integrate.simulate import Trajectory as Motion


class Parts(NamedTuple):
    """How each part ended, in their order; the `loop` is successful where none was asked for.

    Attributes:
        mesh: Nodes follow the drawing.
        path: Equilibria under the load.
        curve: Its samples are in the cells that hold them.
        modes: The states hold as many as are asked for.
        rod: Its laws are finite, its stiffness positive.
        loop: The simulation.
    """

    mesh: Status = Status.successful
    path: Status = Status.successful
    curve: Status = Status.successful
    modes: Status = Status.successful
    rod: Status = Status.successful
    loop: Status = Status.successful


@displayed
class Trajectory(eqx.Module):
    """The motion of a closed loop, and what it was made of on the way from the drawing.

    What comes after a part that failed outside a transformation is None.

    Attributes:
        path: Equilibria of the solid, on the moved mesh.
        backbone: Strains of the curve; `cells` hold its samples.
        basis: Strain modes of the rod.
        fit: Section and laws of the rod, and how well they were found.
        body: The rod with its laws as a block, of which the network was made.
        motion: Of the network, as `systems.simulate` gives it; None without a network.
        parts: How each part ended.
    """

    path: Path | None
    backbone: Backbone | None
    basis: StrainBasis | None
    fit: Fit | None
    body: RodBody | None
    motion: Motion | None
    parts: Parts

    @property
    def status(self) -> Status:
        """That of the first part that failed."""
        found = Status.successful
        for part in self.parts:
            found = Status.where(found == Status.successful, part, found)
        return found

    @property
    def rod(self) -> Rod | None:
        return None if self.body is None else self.body.rod

    @property
    def time(self) -> Float[Array, " time"]:
        """Saved instants [s]."""
        return self._moved().time

    def __getitem__(self, name: str) -> Array:
        return self._moved()[name]

    def _moved(self) -> Motion:
        if self.motion is None:
            raise ValueError(
                "Trajectory: no loop was simulated. Give `network` and `duration`, and look "
                f"at `parts`: {self.parts}."
            )
        return self.motion

    def _text(self) -> str:
        ends = ", ".join(f"{k} {outcome(v)}" for k, v in self.parts._asdict().items())
        rows = [f"Trajectory from a drawing: {ends}"]
        if self.fit is not None:
            fit = self.fit
            misfit = map(number, (fit.stiffness_error, fit.volume_error, fit.position_error))
            told = zip(("stiffness", "volume", "line"), misfit, strict=True)
            rows.append("  misfit of " + ", of ".join(" ".join(pair) for pair in told))
        whole = (self.path, self.backbone, self.rod, self.motion)
        return "\n".join(rows + [str(part) for part in whole if part is not None])


def drawing_to_loop(
    problem: Problem,
    shape: Drawing | None,
    curve: AbstractCurve,
    network: Callable[[RodBody], Network] | None = None,
    duration: float | Float[Array, ""] | None = None,
    *,
    modes: dict[str, int] | dict[str, float],
    damping: Numbers,
    near: Trajectory | None = None,
    before: Drawing | None = None,
    stages: int = 4,
    within: AbstractModes | None = None,
    samples: int = 81,
    arm: float | None = None,
    up: Numbers | None = None,
    degree: int = 5,
    nodes: int | None = None,
    newton: Newton | None = None,
    save: int = 201,
    settle: tuple[str, float] | None = None,
    step: float | None = None,
    solver: dfx.AbstractSolver | None = None,
    adjoint: dfx.AbstractAdjoint | None = None,
    throw: bool = True,
    **values: Float[Array, " steps"],
) -> Trajectory:
    """The closed loop of a soft body, from its drawing: moved mesh, equilibria, rod, motion.

    Nodes of the start mesh move with the drawing (`mesh.move`); `fem.solve_path` follows one
    pressure; strains of a material curve (`reduction.strain_along`) give modes
    (`reduction.pod_basis`), and the condensed stiffness, the equilibria and the enclosed
    volume the laws of a rod (`reduction.identify`); the network made of it runs in time
    (`systems.simulate`). Write the numbers of a design as a function of all these arguments
    and take `jax.grad` or `jax.jvp` of it: the derivative in the drawing, material, pressures,
    valve and controller is exact for cells and modes that are held.

    Which cells hold the samples, and how many modes there are, is chosen in the first call;
    give its result as `near` to hold them in the others. That is needed under `jit` and
    `vmap`, where nothing can be chosen, and where numbers are compared that differ little.

    Args:
        problem: On the start mesh, whose cells are held, with a density and a named pressure.
            Material, thickness and loads may depend on the design, the mesh may not.
        shape: The drawing now, or a tuple of it and its interfaces, as the mesher got them;
            None where the mesh is that of the design.
        curve: Where the rod lies now, from its clamp on [m].
        network: From the rod as a block, with a port `pressure`, to the network around it;
            without it the call ends with the rod.
        duration: Of the motion [s].
        modes: As of `pod_basis`: per strain a number of modes, or in the first call the
            share of the squared strain that they must hold [-].
        damping: Retardation time of the material [s], viscosity over modulus.
        near: A result for a design beside this one, on the same start mesh.
        before, stages: As of `mesh.move`: with the drawing of the start mesh, nodes go farther
            from it, so that one mesh holds for many designs.
        within: As of `pod_basis`: functions that the modes are combined of.
        samples: Along the curve; about one per cell.
        arm: As of `strain_along`: distance of the points beside the curve [m].
        up: In space, a direction near which local z of the rod starts [-].
        degree: Highest power of the pressure in the laws; needs two more states.
        nodes: Gauss nodes of the rod; by default what resolves the modes.
        newton: Tolerances of the equilibria.
        save: Number of saved instants.
        settle: An output that has to come to rest, and the most that it may move in the last
            tenth of the motion, in its unit; by default each finite motion is successful.
        step: A fixed step [s]; adaptive by default.
        solver: Time integration; `Rodas4()` by default, for regulators and valves are far
            faster than the body.
        adjoint: As of `systems.simulate`; `diffrax.ForwardMode()` under `jax.jvp`.
        throw: Raise when a search or the motion fails outside `jit` and `vmap`; otherwise
            report it in `status`.
        **values: The pressures of the path by the name of their load [Pa], as in
            `drawing_to_loop(..., air=jnp.linspace(0, 12 * kPa, 11))`.

    Returns:
        The motion, the rod, its fit, and the `status` of the first part that failed.

    Raises:
        ValueError: If the mesh cannot follow the drawing, the curve leaves the body, the
            states hold fewer modes than asked for, or as the parts named above.
        RuntimeError: If `throw` and a part failed; the message names it.

    Example:
        >>> start = robots.BellowsActuator(num_bellows=2)
        >>> cells = mesh.triangulate(start.body(), size=3 * mm, order=2)
        >>> problem = robots.bellows_problem(
        ...     start, cells, presets.dragon_skin_30(), formulation=fem.Displacement())
        >>> def blown(body):  # a pressure that rises in 0.1 s
        ...     air = systems.Source(systems.SmoothRamp([0, 0.1], [0, 2 * kPa]), unit="Pa")
        ...     return systems.Network({"air": air, "body": body},
        ...                            {"body.pressure": "air.value"})
        >>> def turn(robot, near=None):
        ...     line = reduction.Line([0, 0.5 * mm], jnp.stack([robot.length, 0.5 * mm]))
        ...     run = design.drawing_to_loop(
        ...         problem, robot.body(), line, blown, 0.2, near=near, degree=1,
        ...         modes={"kappa_z": 1}, damping=0.02, air=jnp.linspace(0, 2 * kPa, 3))
        ...     return run["body.tip_angle"][-1], run
        >>> first = turn(start)[1]
        >>> slope = jax.grad(lambda robot: turn(robot, first)[0])(start)
        >>> bool(slope.wall_thickness > 0)  # thicker walls: it turns less to the negative side
        True

    Reference:
        Caasenbrood, Pogromsky and Nijmeijer, Sorotoki, IEEE Access 12, 2024, for the way from
        the solid to the rod.
    """
    if (network is None) != (duration is None):
        raise ValueError(
            "drawing_to_loop: got one of `network` and `duration`, need both for a motion, or "
            "none for the rod alone."
        )
    if near is not None:
        modes = _held_modes(problem.mesh, modes, samples, near)

    def chain():
        """Part after part: its name, how it ended, and what it has found."""
        moved = problem if shape is None else followed(problem, shape, before, stages)
        yield "mesh", _mesh_status(problem.mesh, moved.mesh), {}
        steps: Any = values
        path = solve_path(moved, newton=newton, throw=throw, **steps)
        yield "path", path.status, {"path": path}
        seen = None if near is None else near.backbone
        backbone, at = sampled(path, curve, samples, arm, up, seen)
        status = _curve_status(path.problem.mesh, at)
        yield "curve", status, {"backbone": backbone}
        basis = pod_basis(backbone, modes=modes, within=within)
        yield "modes", _modes_status(backbone, basis), {"basis": basis}
        fit = identified(path, basis, backbone, at, curve, degree, up)
        body = _body(path.problem, backbone, basis, fit, damping, nodes)
        yield "rod", _rod_status(fit), {"fit": fit, "body": body}
        if network is not None and duration is not None:
            run = {"save": save, "step": step, "adjoint": adjoint, "throw": False}
            method = Rodas4() if solver is None else solver
            motion = simulate(network(body), duration, solver=method, **run)
            yield "loop", _loop_status(motion, settle), {"motion": motion}

    found: dict[str, Any] = dict.fromkeys(
        ("path", "backbone", "basis", "fit", "body", "motion")
    )
    ends: dict[str, Status] = {}
    for part, status, made in chain():
        found |= made
        ends[part] = status
        if not is_traced(status) and not bool(status == Status.successful):
            if throw:
                raise RuntimeError(f"drawing_to_loop: {part}: {Status[status]}")
            break
    return Trajectory(**found, parts=Parts(**ends))


def _held_modes(mesh: Mesh, modes: dict, samples: int, near: Trajectory) -> dict[str, int]:
    """The number of modes per strain of `near`, if it can be held."""
    if near.path is None or near.backbone is None or near.basis is None:
        raise ValueError(
            f"drawing_to_loop: `near` ended without modes: {near.parts}. Give a result whose "
            "parts are successful."
        )
    cells, seen = near.path.problem.mesh.num_cells, near.backbone.s.shape[0]
    if (cells, seen) != (mesh.num_cells, samples):
        raise ValueError(
            f"drawing_to_loop: `near` has {seen} samples in a mesh of {cells} cells, need "
            f"{samples} in one of {mesh.num_cells}. Leave `near` out to choose anew."
        )
    kept = {name: of.count for name, of in near.basis.modes.items()}
    wanted = {name: kept.get(name) if isinstance(n, float) else n for name, n in modes.items()}
    if wanted != kept:
        raise ValueError(
            f"drawing_to_loop: got {modes} as modes, `near` has {kept}, need the same. Leave "
            "`near` out to choose anew."
        )
    return kept


# How the parts ended, of numbers without derivatives: at once where they are concrete.


def _mesh_status(mesh: Mesh, moved: Mesh) -> Status:
    before, after = jax.lax.stop_gradient((mesh.points, moved.points))
    with evaluated_now(before, after):
        at = [eqx.tree_at(lambda m: m.points, mesh, points) for points in (before, after)]
        return _unless(distortion(*at).size_ratio > 0, Status.tangled)


_OUT = 0.5  # of the cell beside a sample


def _curve_status(mesh: Mesh, at: Probe):
    points, fibres = without_derivatives((mesh.points, at.fibres))
    with evaluated_now(points, fibres):
        out = _farthest_out(points, fibres, at.locations.nodes)
        return _unless(out < _OUT, Status.outside_mesh)


@jax.jit
def _farthest_out(points, fibres, nodes) -> Array:
    """Of the samples from the boxes around their cells, in sizes of these."""
    corners = points[nodes]
    low, high = jnp.min(corners, axis=1), jnp.max(corners, axis=1)
    x = fibres.reshape(low.shape)
    return jnp.max(jnp.maximum(low - x, x - high) / (high - low))


_STILL = 1e-9  # of a stretch, or of a turn over the length [rad]


def _modes_status(backbone: Backbone, basis: StrainBasis) -> Status:
    backbone = without_derivatives(backbone)
    with evaluated_now(backbone):
        counts = {name: of.count for name, of in basis.modes.items()}
        return _unless(_are_held(backbone, counts), Status.too_few_states)


@once
def _are_held(backbone: Backbone, counts: dict[str, int]) -> Bool[Array, ""]:
    """Whether the states hold so many modes of each strain."""
    root, enough = jnp.sqrt(weights(backbone.s))[None], jnp.array(True)
    for name, count in counts.items():
        change = backbone.change[:, :, backbone.names.index(name)] * root
        size = jnp.linalg.svd(change, compute_uv=False)
        scale = backbone.length if name.startswith("kappa") else 1.0
        enough &= size[0] * scale > _STILL
        enough &= size[count - 1] > RANK * size[0]
    return enough


def _rod_status(fit: Fit) -> Status:
    fit = without_derivatives(fit)
    with evaluated_now(fit):
        numbers = jax.tree.leaves(eqx.filter(fit, eqx.is_inexact_array))
        good, stiff = _finite_and_stiff(numbers, fit.elastic.stiffness)
        unstable = _unless(stiff, Status.unstable_equilibrium)
        return Status.where(good, unstable, Status.not_finite)


@jax.jit
def _finite_and_stiff(numbers: list[Array], stiffness: Array) -> tuple[Array, Array]:
    good = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in numbers]))
    return good, jnp.linalg.eigvalsh(jnp.where(good, stiffness, 0.0))[0] > 0


def _loop_status(motion: Motion, settle: tuple[str, float] | None) -> Status:
    if settle is None:
        return motion.status
    name, most = settle
    output = without_derivatives(motion[name])
    with evaluated_now(output):
        last = output[-max(len(output) // 10, 2) :]
        still = jnp.all(jnp.ptp(last, axis=0) <= most)
    rest = _unless(still, Status.not_settled)
    return Status.where(motion.status == Status.successful, rest, motion.status)


def _unless(good, otherwise: Status) -> Status:
    return Status.where(good, Status.successful, otherwise)


def _body(problem: Problem, backbone: Backbone, basis, fit: Fit, damping, nodes) -> RodBody:
    group: Any = SE2() if problem.mesh.element.dim == 2 else SE3()
    rest: Any = None if backbone.rest is None else backbone.rest_strain
    made = rod(
        group,
        basis,
        fit.section,
        _elastic(problem),
        length=fit.length,
        rest_strain=rest,
        nodes=nodes,
    )
    return RodBody(made, (fit.elastic, fit.pressure, fit.damping(damping)))


def _elastic(problem: Problem) -> Elastic:
    """Constants of the mean over the cells. Of these only the mass moves the rod, whose
    stiffness is that of its fit: the moduli have no derivative."""
    rubber = _mean(problem.mesh, problem.material)
    fixed = without_derivatives(rubber)
    with evaluated_now(fixed):
        made = elastic(fixed)
    return Elastic(made.young_modulus, made.poisson_ratio, rubber.density)


@two_programs
def _mean(mesh: Mesh, material):
    """The material with the mean of each number that differs from cell to cell."""
    sizes = (cell_areas if mesh.element.dim == 2 else cell_volumes)(mesh)
    share, count = sizes / jnp.sum(sizes), mesh.num_cells

    def mean(x):
        per_cell = eqx.is_inexact_array(x) and x.shape[:1] == (count,)
        return jnp.tensordot(share, x, 1) if per_cell else x

    return jax.tree.map(mean, material)
