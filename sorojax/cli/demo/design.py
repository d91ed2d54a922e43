"""The bellows actuator: drawing, rubber, mesh and problem; its rod and the closed loop."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import SE2, fem, material, mesh, reduction, robots, rod, sdf, systems
from sorojax.design import drawing_to_loop
from sorojax.fem.equilibrium.solve import Path
from sorojax.material.fit import TensileFit
from sorojax.reduction.backbone import Backbone
from sorojax.reduction.identify import Fit
from sorojax.robots import BellowsActuator
from sorojax.units import kPa, ml, mm

DEPTH = 20 * mm
LAYER_STIFFNESS = 10.0
TOP_PRESSURE = 20 * kPa
DENSITY = 1080.0


class Design(NamedTuple):
    """The actuator, its rubber and the boundary value problem on its cross-section."""

    actuator: BellowsActuator
    tensile: TensileFit
    problem: fem.Problem
    area: float
    meshed_area: float

    @property
    def chamber_facets(self) -> Int[Array, "facets facet_nodes"]:
        (air,) = self.problem.loads
        assert isinstance(air, fem.Pressure)
        return air.facets


def draw(size: float) -> Design:
    """The design with cells of about `size` [m]."""
    actuator = BellowsActuator()
    tensile = material.fit_tensile(
        *material.presets.DRAGON_SKIN_30_POINTS, poisson_ratio=0.49, density=DENSITY
    )
    body = actuator.body()
    cells = mesh.triangulate(body, size=size, order=2, interfaces=(actuator.layer(),))
    return Design(
        actuator,
        tensile,
        # stiffer by some 1.5 %: two cells through a wall
        bellows_problem(actuator, cells, tensile.material, DEPTH, fem.Displacement()),
        float(sdf.area(body)),
        float(jnp.sum(mesh.cell_areas(cells))),
    )


def bellows_problem(
    actuator: BellowsActuator,
    cells: mesh.Mesh,
    rubber: material.AbstractHyperelastic,
    depth: float,
    formulation: fem.Displacement | None = None,
) -> fem.Problem:
    """Clamped at its left end, stiffer in its layer, pressure called "air"."""
    layer = actuator.layer()
    stiff = np.ones(cells.num_cells)
    stiff[mesh.cells_where(cells, lambda p: layer(p) < 0)] = LAYER_STIFFNESS
    scaled = material.Scaled(rubber, stiff)
    return robots.bellows_problem(actuator, cells, scaled, depth=depth, formulation=formulation)


DIMENSIONS = (
    "wall_thickness", "bellow_width", "gap", "base", "chamber_height", "roof", "fillet",
)  # fmt: skip


class Sensitivity(NamedTuple):
    """Tip rotation [rad] at the top pressure and its derivative in every dimension.

    `difference` is the central difference (order 4) in the wall thickness [rad/m].
    """

    rotation: float
    gradient: dict[str, float]
    difference: float

    @property
    def error(self) -> float:
        return abs(self.gradient["wall_thickness"] / self.difference - 1)


def sensitivity(design: Design, path: Path) -> Sensitivity:
    """d(tip rotation)/d(dimensions) by reverse mode, through mesh motion and equilibrium."""
    value, slopes = jax.value_and_grad(lambda a: tip_rotation(a, design, path))(design.actuator)
    gradient = {name: float(getattr(slopes, name)) for name in DIMENSIONS}
    return Sensitivity(float(value), gradient, _difference(design, path, 10e-6))


def tip_rotation(actuator: BellowsActuator, design: Design, path: Path) -> Float[Array, ""]:
    """Rotation of the end face [rad] at the last pressure of `path`, negative when the
    actuator curls towards its layer."""
    flat = design.problem.mesh
    moved = mesh.move(flat, actuator.body(), interfaces=(actuator.layer(),))
    problem = eqx.tree_at(
        lambda p: (p.mesh.points, p.loads[0].value),
        design.problem,
        (moved.points, path.values[-1]),
    )
    tight = fem.Newton(residual_tolerance=1e-12)
    solution = fem.solve(problem, start=path.displacements[-1], newton=tight)
    a = design.actuator
    ends = [mesh.nearest_node(flat, [a.length, y]) for y in (0.0, a.height)]
    face = (problem.mesh.points + solution.displacement)[jnp.array(ends)]
    across = face[1] - face[0]
    return jnp.arctan2(-across[0], across[1])


def _difference(design: Design, path: Path, h: float) -> float:
    def at(k: int) -> float:
        wall = design.actuator.wall_thickness + k * h
        changed = eqx.tree_at(lambda a: a.wall_thickness, design.actuator, wall)
        return float(tip_rotation(changed, design, path))

    return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * h)


# The rod that stands in for the solid, and the closed loop around it.


#: Retardation time of the rubber [s]; an assumption, no measurement is public.
DAMPING_TIME = 0.01


class Reduced(NamedTuple):
    """Backbone snapshots, strain modes, identified laws and the rod with them."""

    backbone: Backbone
    basis: rod.StrainBasis
    captured: dict[str, Float[Array, ""]]
    fit: Fit
    rod: rod.Rod
    forces: tuple
    states: Float[Array, "steps dof"]
    errors: Float[np.ndarray, " steps"]


def reduce(design: Design, path: Path) -> Reduced:
    """Three bending modes from the path, and the rod's own equilibrium at every pressure.

    `errors` is the mean distance [m] between the rod's backbone and that of the solid.
    """
    line = _middle(design.actuator)
    backbone = reduction.strain_along(path, line)
    basis = reduction.pod_basis(backbone, modes={"kappa_z": 3})
    fit = reduction.identify(path, basis, backbone, line)
    body = rod.rod(
        SE2(), basis, fit.section, rod.elastic(design.tensile.material), length=fit.length
    )
    states = [jnp.zeros(basis.num_dof)]
    for pressure in path.values:
        loads = (fit.elastic, rod.Pressurised(fit.pressure, pressure))
        states.append(rod.equilibrium(body, loads, states[-1]).q)
    q = jnp.stack(states[1:])
    poses = jax.vmap(lambda q: rod.forward_kinematics(body, q, backbone.s))(q)
    gap = jnp.linalg.norm(poses[:, :, :2, 2] - backbone.positions, axis=-1)
    forces = (fit.elastic, fit.pressure, fit.damping(DAMPING_TIME))
    return Reduced(
        backbone,
        basis,
        reduction.captured_energy(backbone, basis),
        fit,
        body,
        forces,
        q,
        np.asarray(jnp.mean(gap, axis=1)),
    )


def reference_angle(full: float, duration: float) -> systems.SmoothRamp:
    """Three moves within `duration` [s], in shares of the angle `full` [rad]."""
    times = np.array([0.0, 0.1, 0.3, 0.46, 0.62, 0.78, 0.94])
    shares = np.array([0.0, 0.0, 0.6, 0.6, 0.25, 0.25, 0.8])
    return systems.SmoothRamp(duration * times, shares * full)


def controller(
    full: float, top: float, reference: systems.AbstractReference | None = None
) -> systems.PID:
    """PID from the tip angle [rad] to a pressure [Pa], for an actuator that reaches the angle
    `full` at the pressure `top`."""
    per_angle = top / full
    return systems.PID(
        proportional=0.5 * per_angle,
        integral_gain=8.0 * per_angle,
        derivative=0.05 * per_angle,
        feed_forward=0.9 * per_angle,
        low=0.0,
        high=1.2 * top,
        filter_time=0.01,
        reference=reference,
    )


def valve() -> systems.Regulator:
    """A small bench regulator."""
    return systems.Regulator(1.5e-8, integral_gain=3e-8, max_flow=3e-5)


def closed_loop(reduced: Reduced, path: Path, duration: float) -> systems.Network:
    """Reservoir, regulator, rod and PID: the tip follows a reference angle."""
    full = full_angle(reduced)
    reference = systems.Source(reference_angle(full, duration), unit="rad")
    pid = controller(full, float(path.values[-1]))
    return loop_of(reference, pid, valve(), systems.RodBody(reduced.rod, reduced.forces))


def loop_of(
    target: systems.Source,
    pid: systems.PID,
    valve: systems.Regulator,
    body: systems.RodBody,
    sensor: systems.Function | None = None,
    seen: str = "tip_position",
) -> systems.Network:
    """The angle of the tip of `body` follows `target`, by air through `valve`; with a `sensor`
    what that makes of the output `seen` of the body."""
    measured, sensors = {"pid.measurement": "body.tip_angle"}, {}
    if sensor is not None:
        sensors = {"sensor": sensor}
        measured = {"sensor.a": f"body.{seen}", "pid.measurement": "sensor.value"}
    return systems.Network(
        blocks={
            **sensors,
            "target": target,
            "pid": pid,
            "valve": valve,
            "air": systems.Reservoir(dead_volume=2 * ml),
            "body": body,
        },
        wires={
            "pid.reference": "target.value",
            **measured,
            "valve.setpoint": "pid.command",
            "valve.pressure": "air.pressure",
            "air.mass_flow": "valve.mass_flow",
            "air.volume": "body.volume",
            "air.volume_rate": "body.volume_rate",
            "air.compliance": "body.compliance",
            "body.pressure": "air.pressure",
        },
    )


class LoopSensitivity(NamedTuple):
    """Root mean square of the tracking error [rad] and its derivative in every dimension of the
    drawing [rad/m] and every gain [rad per unit of the gain].

    `differences` are central differences (order 4) in some of them.
    """

    rms: float
    gradient: dict[str, float]
    differences: dict[str, float]

    @property
    def error(self) -> float:
        """The largest error of a derivative that was checked."""
        return max(abs(self.gradient[k] / slope - 1) for k, slope in self.differences.items())


GAINS = ("proportional", "integral_gain", "derivative", "feed_forward")


def loop_sensitivity(
    design: Design, path: Path, full: float, duration: float
) -> LoopSensitivity:
    """d(tracking error)/d(dimensions and gains) by reverse mode, through the whole chain from
    the drawing to the closed loop; `full` is the angle at the top pressure [rad]."""
    pid = controller(full, float(path.values[-1]))
    target = systems.Source(reference_angle(full, duration), unit="rad")
    start = {name: getattr(design.actuator, name) for name in DIMENSIONS}
    start |= {name: getattr(pid, name) for name in GAINS}

    def run(numbers, near=None):
        changed = {name: numbers[name] for name in DIMENSIONS}
        actuator = dataclasses.replace(design.actuator, **changed)
        tuned = dataclasses.replace(pid, **{name: numbers[name] for name in GAINS})
        return drawing_to_loop(
            design.problem,
            (actuator.body(), actuator.layer()),
            _middle(actuator),
            lambda body: loop_of(target, tuned, valve(), body),
            duration,
            modes={"kappa_z": 3},
            damping=DAMPING_TIME,
            near=near,
            air=jnp.linspace(0.0, path.values[-1], 9),
        )

    first = run(start)

    def cost(numbers):
        return rms(run(numbers, first))

    value, slopes = jax.value_and_grad(cost)(start)
    seen = {name: _slope(cost, start, name) for name in ("wall_thickness", "integral_gain")}
    return LoopSensitivity(float(value), {k: float(x) for k, x in slopes.items()}, seen)


def _middle(actuator: BellowsActuator) -> reduction.Line:
    """The middle of the layer, from the clamp to the tip."""
    middle = actuator.layer_thickness / 2
    return reduction.Line(jnp.stack([0 * middle, middle]), jnp.stack([actuator.length, middle]))


def _slope(cost, start: dict[str, Array], name: str) -> float:
    """By one number, from differences of fourth order."""
    h = 1e-3 * float(start[name])
    at = {k: float(cost(start | {name: start[name] + k * h})) for k in (-2, -1, 1, 2)}
    return (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * h)


def rms(film) -> Float[Array, ""]:
    """Of the tracking error [rad]."""
    return jnp.sqrt(jnp.mean((film["body.tip_angle"] - film["target.value"]) ** 2))


class Tracking(NamedTuple):
    """How well the tip followed its reference [rad]."""

    rms: float
    final: float
    peak_pressure: float
    steps: int


def tracking(film: systems.Trajectory) -> Tracking:
    final = film["body.tip_angle"][-1] - film["target.value"][-1]
    return Tracking(
        float(rms(film)),
        float(jnp.abs(final)),
        float(jnp.max(film["air.pressure"])),
        int(film.stats["steps"]),
    )


def full_angle(reduced: Reduced) -> float:
    """Of the tip at the top pressure [rad]."""
    return float(rod.tip_angle(rod.motion(reduced.rod, reduced.states[-1])))
