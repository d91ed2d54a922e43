"""A bellows of finite elements with air and a regulator: coupled, alone, and reduced.

Five bellows, side view, plane strain, filled to 5 kPa in 60 ms. The cost of a coupled step
beside that of `fem.simulate` under the same pressures; a body of few shapes beside the full.
"""

import jax
import numpy as np

from benchmarks.harness import Row, measure_calls
from sorojax import fem, material, mesh, systems
from sorojax.robots import BellowsActuator
from sorojax.units import MPa, kPa, mm

STEP, DURATION, TARGET = 2e-3, 0.06, 5 * kPa
STEPS = round(DURATION / STEP)
MODES = 3


def body(size: float = 1.5 * mm) -> systems.FemBody:
    actuator = BellowsActuator()
    cells = mesh.triangulate(actuator.body(), size=size, order=2)
    problem = fem.problem(
        cells,
        material.NeoHookean(400 * kPa, 4 * MPa, density=1080.0),
        kinematics=fem.PlaneStrain(20 * mm),
        supports=(fem.Fixed(mesh.nodes_where(cells, lambda p: p[0] < 1e-9)),),
        loads=(fem.Pressure(mesh.facets_on(cells, actuator.chambers()), name="air"),),
    )
    tip = mesh.nearest_node(cells, (float(actuator.length), 0.0))
    return systems.FemBody(problem, fem.Rayleigh(5.0, 1e-3), markers={"tip": tip})


def network(block) -> systems.Network:
    blocks = {
        "body": block,
        "air": systems.Reservoir(),
        "valve": systems.Regulator(3e-9, 3e-8),
        "goal": systems.Source(systems.SmoothRamp([0.0, 0.04], [0.0, TARGET]), unit="Pa"),
    }
    wires = {
        "body.air_pressure": "air.pressure",
        "air.volume": "body.air_volume",
        "air.volume_rate": "body.air_volume_rate",
        "air.mass_flow": "valve.mass_flow",
        "valve.pressure": "air.pressure",
        "valve.setpoint": "goal.value",
    }
    return systems.Network(blocks, wires)


def rows():
    full = body()
    size = {"dof": full.problem.space.num_dofs, "steps": STEPS}
    coupled = network(full)

    def run():
        return systems.simulate(coupled, DURATION, save=STEPS + 1, step=STEP)

    film = run()
    moved = film["body.tip_position"] - film["body.tip_position"][0]
    scale = float(np.abs(moved).max())
    timing = measure_calls(lambda: run()["air.pressure"], 3)

    def alone():
        return fem.simulate(
            full.problem, DURATION, STEP, damping=full.damping, air=film["air.pressure"]
        ).end.displacement

    (_, node), *_ = full.markers
    missed = float(np.abs(alone()[node] - moved[-1]).max()) / scale
    yield Row(
        "sorojax",
        {"body": "full, with air", **size},
        **timing.per(STEPS).columns(),
        error=missed,
        reference="fem.simulate under its pressures, tip over its largest move",
    )
    timing = measure_calls(alone, 3)
    yield Row("sorojax", {"body": "fem.simulate", **size}, **timing.per(STEPS).columns())
    basis = systems.modal_basis(full, MODES)
    for order in (1, 3):
        small = network(systems.modal_body(full, basis, order=order))

        def go(small=small):
            return systems.simulate(
                small,
                DURATION,
                save=STEPS + 1,
                step=STEP / 4,
                solver=systems.Rosenbrock2(refresh=True),
            )["body.tip_position"]

        tip = jax.block_until_ready(go())
        timing = measure_calls(go, 3)
        yield Row(
            "sorojax",
            {"body": f"reduced, order {order}", "shapes": len(basis), "steps": STEPS},
            **timing.per(STEPS).columns(),
            error=float(np.abs((tip - tip[0]) - moved).max()) / scale,
            reference="the full body, tip over its largest move",
        )
