"""The bellows actuator: drawing, rubber, mesh and problem; from there to its closed loop."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import fem, material, mesh, reduction, robots, rod, sdf, systems, view
from sorojax.design import drawing_to_loop
from sorojax.design.closed_loop import Trajectory
from sorojax.material.fit import TensileFit
from sorojax.robots import BellowsActuator
from sorojax.units import deg, kPa, ml, mm

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


# The closed loop around the rod that stands in for the solid.

#: Retardation time of the rubber [s]; an assumption, no measurement is public.
DAMPING_TIME = 0.01
#: By which the end turns at the top pressure, as the controller has it [rad].
FULL_ANGLE = -71.5 * deg


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


# From the drawing to the closed loop, and the derivatives of all of it.

DIMENSIONS = (
    "wall_thickness", "bellow_width", "gap", "base", "chamber_height", "roof", "fillet",
)  # fmt: skip
GAINS = ("proportional", "integral_gain", "derivative", "feed_forward")


class Job(NamedTuple):
    """The design with its pressures [Pa] and the time that it has for its moves [s]."""

    design: Design
    pressures: Float[Array, " steps"]
    duration: float

    @property
    def numbers(self) -> dict[str, Array]:
        """Every dimension of the drawing [m] and every gain."""
        sources = ((DIMENSIONS, self.design.actuator), (GAINS, self.pid))
        return {name: getattr(of, name) for names, of in sources for name in names}

    @property
    def pid(self) -> systems.PID:
        return controller(FULL_ANGLE, TOP_PRESSURE)

    def run(self, numbers: dict[str, Array], near: Trajectory | None = None) -> Trajectory:
        """The motion of the closed loop of the actuator with these numbers."""
        changed = {name: numbers[name] for name in DIMENSIONS}
        actuator = dataclasses.replace(self.design.actuator, **changed)
        pid = dataclasses.replace(self.pid, **{name: numbers[name] for name in GAINS})
        moves = reference_angle(FULL_ANGLE, self.duration)
        target = systems.Source(moves, unit="rad")
        return drawing_to_loop(
            self.design.problem,
            (actuator.body(), actuator.layer()),
            _middle(actuator),
            lambda body: loop_of(target, pid, valve(), body),
            self.duration,
            modes={"kappa_z": 3},
            damping=DAMPING_TIME,
            near=near,
            save=int(100 * self.duration) + 1,
            air=self.pressures,
        )


def _middle(actuator: BellowsActuator) -> reduction.Line:
    """The middle of the layer, from the clamp to the tip."""
    middle = actuator.layer_thickness / 2
    return reduction.Line(jnp.stack([0 * middle, middle]), jnp.stack([actuator.length, middle]))


def rotation(job: Job, run: Trajectory) -> Float[Array, ""]:
    """Of the end face of the solid at the top pressure [rad], negative towards the layer."""
    assert run.path is not None
    flat, robot = job.design.problem.mesh, job.design.actuator
    ends = [mesh.nearest_node(flat, [robot.length, y]) for y in (0.0, robot.height)]
    bent = run.path.problem.mesh.points + run.path.displacements[-1]
    across = bent[ends[1]] - bent[ends[0]]
    return jnp.arctan2(-across[0], across[1])


def rms(film) -> Float[Array, ""]:
    """Of the tracking error [rad]."""
    return jnp.sqrt(jnp.mean((film["body.tip_angle"] - film["target.value"]) ** 2))


class Sensitivity(NamedTuple):
    """A number of the run, its derivative in every dimension and gain by reverse mode, and by
    how much they differ from a central difference along a change of all, relative to it [-]."""

    value: float
    gradient: dict[str, float]
    error: float


def sensitivities(job: Job, first: Trajectory) -> dict[str, Sensitivity]:
    """Of the `rotation` [rad] and the `rms` [rad] by all numbers: through the motion of the
    mesh, equilibria, strain modes, laws of the rod and the closed loop."""

    def costs(numbers: dict[str, Array]) -> dict[str, Array]:
        run = job.run(numbers, first)
        return {"rotation": rotation(job, run), "rms": rms(run)}

    start = job.numbers
    values, pull = jax.vjp(costs, start)
    slopes = {}
    for name in values:
        seed = {other: jnp.array(float(other == name)) for other in values}
        slopes[name] = {k: float(x) for k, x in pull(seed)[0].items()}
    # each number changes by a share of itself, the way that lets the tracking error rise
    step = {k: 1e-4 * float(jnp.sign(slopes["rms"][k]) * x) for k, x in start.items()}
    ahead, behind = (costs({k: start[k] + side * step[k] for k in start}) for side in (1, -1))
    found = {}
    for name, value in values.items():
        along = sum(slopes[name][k] * step[k] for k in start)
        error = abs(2 * along / float(ahead[name] - behind[name]) - 1)
        found[name] = Sensitivity(float(value), slopes[name], error)
    return found


class Tracking(NamedTuple):
    """How well the tip followed its reference [rad]."""

    rms: float
    final: float
    peak_pressure: float
    steps: int


def tracking(run: Trajectory) -> Tracking:
    assert run.motion is not None
    final = run["body.tip_angle"][-1] - run["target.value"][-1]
    return Tracking(
        float(rms(run)),
        float(jnp.abs(final)),
        float(jnp.max(run["air.pressure"])),
        int(run.motion.stats["steps"]),
    )


class Bent(NamedTuple):
    """The rod at rest under each pressure, and the mean distance of its backbone from that of
    the solid [m]."""

    states: Float[Array, "steps dof"]
    errors: Float[np.ndarray, " steps"]


def bent(run: Trajectory) -> Bent:
    """The rod's own equilibria beside those of the solid."""
    assert run.rod is not None and run.fit is not None
    assert run.path is not None and run.backbone is not None
    body, fit = run.rod, run.fit
    states = [jnp.zeros(body.basis.num_dof)]
    for pressure in run.path.values:
        loads = (fit.elastic, rod.Pressurised(fit.pressure, pressure))
        states.append(rod.equilibrium(body, loads, states[-1]).q)
    q = jnp.stack(states[1:])
    return Bent(q, np.asarray(view.backbone_errors(run.backbone, body, q)))
