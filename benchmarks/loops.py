"""Closed loops drawn from the drawings of three robots, each with all its numbers.

Every robot gives its drawing, problem, line, pressures and loop; `Loop` has the numbers of
drawing, rubber, valve and controller as one vector, the cost as a function of it, and the
largest error of its gradient.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from sorojax import design, fem, material, mesh, reduction, robots, sdf, systems
from sorojax.cli.demo.design import bellows_problem, loop_of
from sorojax.units import kPa, mm

STEP = 1e-4  # of each number


class Robot(NamedTuple):
    """What a loop is made of, and `run`: from all its numbers and an earlier result to one."""

    numbers: Any
    run: Any
    cost: Any
    cells: int
    modes: dict[str, int]


class Loop:
    """The cost of a closed loop as a function of one vector of numbers."""

    def __init__(self, robot: Robot, **options: Any):
        moving, self.rest = eqx.partition(robot.numbers, eqx.is_inexact_array)
        self.numbers, self.build = ravel_pytree(moving)
        self.robot, self.options = robot, {"modes": robot.modes} | options
        self.near = self.run(self.numbers)

    def run(self, numbers, near=None, **options):
        options = self.options | {"near": near} | options
        return self.robot.run(*eqx.combine(self.build(numbers), self.rest), **options)

    def cost(self, numbers):
        return self.robot.cost(self.run(numbers, self.near))

    @property
    def varied(self) -> np.ndarray:
        """The numbers that are neither zero nor infinite."""
        numbers = np.asarray(self.numbers)
        return np.flatnonzero(np.isfinite(numbers) & (numbers != 0))

    def error(self, gradient) -> float:
        """The largest difference to central differences of fourth order, each number scaled
        by itself, over the larger of the component and a thousandth of the largest one."""
        seen = np.array([self._difference(int(k)) for k in self.varied])
        size = np.asarray(self.numbers)[self.varied]
        found = np.asarray(gradient)[self.varied] * size
        wrong, most = found - seen * size, np.abs(found).max()
        return float(np.max(np.abs(wrong) / np.maximum(np.abs(found), 1e-3 * most)))

    def _difference(self, k: int) -> float:
        way = jnp.zeros_like(self.numbers).at[k].set(STEP * self.numbers[k])
        at = {j: float(self.cost(self.numbers + j * way)) for j in (-2, -1, 1, 2)}
        return (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / float(12 * STEP * self.numbers[k])


def _following(end, unit: str, duration: float, pid, valve, sensor=None):
    """From the body to its loop, whose target rises to `end` in 0.4 of the time."""
    target = systems.Source(systems.SmoothRamp([0.0, 0.4 * duration], [0.0, end]), unit=unit)
    return lambda body: loop_of(target, pid, valve, body, sensor)


def _along(pressure: float, states: int, duration: float) -> dict[str, Any]:
    """What all chains share, and the pressures of the path."""
    air = jnp.linspace(0, pressure, states)
    shared = {"damping": 0.02, "degree": min(5, states - 2), "save": 101}
    return {"duration": duration, "air": air} | shared


def bellows(
    size: float, duration: float, states: int = 11, mixed: bool = False, **actuator: Any
) -> Robot:
    """The bellows actuator of the demo with a PID on its tip angle; with pressures as unknowns
    in `mixed` cells."""
    first = robots.BellowsActuator(**actuator)
    flat = mesh.triangulate(first.body(), size=size, order=2, interfaces=(first.layer(),))
    flat = mesh.enrich(flat) if mixed else flat
    rubber = material.presets.dragon_skin_30()
    start = bellows_problem(first, flat, rubber, 20 * mm, None if mixed else fem.Displacement())
    valve = systems.Regulator(1.5e-8, integral_gain=3e-8, max_flow=3e-5)
    pid = systems.PID(-8 * kPa, integral_gain=-60 * kPa, derivative=-0.8 * kPa, low=0.0)

    def run(actuator, law, valve, pid, **options: Any):
        middle = actuator.layer_thickness / 2
        return design.drawing_to_loop(
            eqx.tree_at(lambda p: p.material.base, start, law),
            (actuator.body(), actuator.layer()),
            reduction.Line(*(jnp.stack([x, middle]) for x in (0 * middle, actuator.length))),
            _following(-0.4, "rad", duration, pid, valve),
            **_along(12 * kPa, states, duration),
            **options,
        )

    return Robot((first, rubber, valve, pid), run, tracking, flat.num_cells, {"kappa_z": 3})


def pneunet(size: float, duration: float, states: int = 11, **dimensions: Any) -> Robot:
    """A PneuNet below the pressure at which its walls meet, with a PID on its tip angle."""
    first = robots.PneuNet(**dimensions)
    sides = (first.body(), layer_of(first))
    flat = mesh.triangulate(sides[0], size=size, order=2, interfaces=sides[1:])
    stiff = np.ones(flat.num_cells)
    stiff[mesh.cells_where(flat, lambda p: sides[1](p) < 0)] = 10.0
    rubber = material.presets.dragon_skin_30()
    start = fem.problem(
        flat,
        material.Scaled(rubber, stiff),
        kinematics=fem.PlaneStrain(20 * mm),
        supports=(fem.Fixed(mesh.nodes_where(flat, lambda p: p[0] < 1e-9)),),
        loads=(fem.Pressure(mesh.facets_on(flat, first.chambers()), name="air"),),
        formulation=fem.Displacement(),
    )
    valve = systems.Regulator(1.5e-8, integral_gain=3e-8, max_flow=3e-5)
    per_angle = 4 * kPa / PNEUNET_TURN / first.num_chambers
    pid = systems.PID(
        per_angle, integral_gain=8 * per_angle, derivative=0.05 * per_angle, low=0.0
    )

    def run(pneunet, law, valve, pid, **options: Any):
        middle = pneunet.layer / 2
        turn = 0.6 * PNEUNET_TURN * pneunet.num_chambers
        return design.drawing_to_loop(
            eqx.tree_at(lambda p: p.material.base, start, law),
            (pneunet.body(), layer_of(pneunet)),
            reduction.Line(*(jnp.stack([x, middle]) for x in (0 * middle, pneunet.length))),
            _following(turn, "rad", duration, pid, valve),
            **_along(4 * kPa, states, duration),
            **options,
        )

    return Robot((first, rubber, valve, pid), run, tracking, flat.num_cells, {"kappa_z": 3})


PNEUNET_TURN = -0.08  # of a chamber at 4 kPa [rad]


def layer_of(pneunet: robots.PneuNet) -> sdf.AbstractSdf:
    return sdf.HalfPlane(jnp.stack([0 * pneunet.layer, pneunet.layer]), [0.0, 1.0])


def finger(
    size: float, duration: float, states: int = 7, folds: int = 3, order: int = 2
) -> Robot:
    """A printed finger in space, with a PID on how far its tip leaves its axis."""
    bellows = robots.Bellows(
        outer_radius=9 * mm, inner_radius=5.6 * mm, pitch=9 * mm, fold_height=6 * mm,
        wall_thickness=2 * mm, cap=2.5 * mm, fillet=1.2 * mm, num_folds=folds,
    )  # fmt: skip
    first = robots.Finger(
        bellows, tip_radius=6.5 * mm, spine_width=7 * mm, spine_thickness=7.2 * mm
    )
    solid = mesh.tetrahedralise(blended(first), size=size, order=order)
    found = mesh.chambers(solid)
    (chamber,) = found.volumes
    rubber = material.presets.dragon_skin_30()
    start = fem.problem(
        solid,
        rubber,
        kinematics=fem.Solid(),
        supports=(fem.Fixed(mesh.nodes_where(solid, lambda p: p[2] < 1e-9)),),
        loads=(fem.Pressure(found.mesh.facet_sets[chamber], name="air"),),
        formulation=fem.Displacement(),
    )
    valve = systems.Regulator(1.5e-8, integral_gain=3e-8, max_flow=3e-5)
    sensor = systems.Function(_across, ("a",), (), "m", (3,), "m")
    gain = FINGER_PRESSURE / FINGER_TIP
    slow, fast = 8 * gain, 0.02 * gain
    pid = systems.PID(gain, integral_gain=slow, derivative=fast, low=0.0, measurement_unit="m")

    def run(finger, law, valve, pid, **options: Any):
        b = finger.bellows
        x, zero = b.wall_thickness / 2 - b.outer_radius, 0 * b.cap
        foot = b.cap / 5  # the edge of the spine is round
        end = b.length - b.cap - b.pitch / 2 - finger.spine_thickness / 4
        return design.drawing_to_loop(
            eqx.tree_at(lambda p: p.material, start, law),
            blended(finger),
            reduction.Line(jnp.stack([x, zero, foot]), jnp.stack([x, zero, end])),
            _following(0.6 * FINGER_TIP, "m", duration, pid, valve, sensor),
            up=[1.0, 0.0, 0.0],
            **_along(FINGER_PRESSURE, states, duration),
            **options,
        )

    modes = {"kappa_y": 2, "sigma_x": 1}
    return Robot((first, rubber, valve, pid), run, leaving, solid.num_cells, modes)


FINGER_PRESSURE = 40 * kPa
FINGER_TIP = -0.6 * mm


def blended(finger: robots.Finger) -> sdf.AbstractSdf:
    """The finger without its tip, its spine in smooth transition to the bellows: where two
    faces meet at a small angle, a ridge of the mesh has no place that it keeps."""
    b, half = finger.bellows, finger.spine_width / 2
    outside = -b.outer_radius - finger.spine_thickness / 3
    spine = sdf.Box(
        jnp.stack([outside, -half, 0 * half]),
        jnp.stack([outside + finger.spine_thickness, half, b.length - b.cap - b.pitch / 2]),
        finger.spine_thickness / 4,
    )
    return sdf.SmoothUnion(b.solid(), spine, finger.tip_radius / 4) - finger.chamber()


def _across(position):
    """How far the tip has left the axis of the rod, which is its local x."""
    return position[2]


def tracking(film) -> Any:
    """Mean square of the difference to the angle that is asked for [rad^2]."""
    return jnp.mean((film["body.tip_angle"] - film["target.value"]) ** 2)


def leaving(film) -> Any:
    """The same of the place of the tip [mm^2]."""
    return jnp.mean(((film["sensor.value"] - film["target.value"]) / mm) ** 2)
