"""A finite-element body and its gas behind the valve board, without and with a socket."""

import contextlib
import time

import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import fem, material, mesh, robots, systems as S
from sorojax.systems.blocks.fem_body import volume
from sorojax_board.board import settings
from sorojax_board.messages import State
from sorojax_hardware import (
    BoardFault,
    LocalBoard,
    ModelValves,
    SimulatedClock,
    TcpBoard,
    run_loop,
    serve,
)

kPa = 1e3
PERIOD = 5e-3


@pytest.fixture(scope="module")
def tube():
    """A length of a rubber tube between two plates, of two cells: problem, model, stepper."""
    grid = mesh.rectangle([5e-3, 0], [8e-3, 4e-3], divisions=(2, 1), order=2)
    rubber = material.neo_hookean(young_modulus=0.3e6, poisson_ratio=0.45, density=1000.0)
    problem = fem.problem(
        grid,
        rubber,
        kinematics=fem.Axisymmetric(),
        space=fem.space(grid),
        supports=(
            fem.Fixed(grid.node_sets["bottom"], (1,)),
            fem.Fixed(grid.node_sets["top"], (1,)),
        ),
        loads=(fem.Pressure(grid.facet_sets["left"], name="tube"),),
    )
    skin = mesh.nearest_node(grid, (8e-3, 0.0))
    body = S.FemBody(problem, fem.KelvinVoigt(300.0), markers={"skin": skin})
    gas = volume(problem, problem.loads[0], jnp.zeros_like(grid.points))
    port = robots.Port(("tube",), gas, -10 * kPa, 50 * kPa)
    # a leak of 2 % a second and a short tube
    supply = robots.Supply(leakage=0.02, tube_volume=2e-6)
    model = robots.with_pneumatics(body, {"tube": port}, supply)
    return problem, skin, model, robots.stepper(model, PERIOD, substeps=1)


def test_a_solid_behind_a_board_swells_as_statics_has_it(tube):
    problem, skin, model, (advance, start) = tube
    valves = ModelValves(advance, start, 1, noise=80.0, dead_time=0.004)
    clock, limits = SimulatedClock(), settings(1, low=-10 * kPa, high=50 * kPa)
    board = LocalBoard(limits, valves, clock)
    board.arm()
    ticks = list(
        run_loop(
            board,
            clock,
            lambda t, p, s: (30 * kPa, s),
            None,
            duration=0.4,
            period=0.01,
            limits=(0.0, 50 * kPa),
        )
    )
    pressure = np.array([tick.pressure[0] for tick in ticks])
    assert pressure[1] < 25 * kPa and np.allclose(pressure[-10:], 30 * kPa, atol=400)
    moved = float(valves.state.state["body"]["u"][skin, 0])
    load = fem.Pressure(problem.loads[0].facets, float(valves.pressure[0]))
    still = fem.solve(
        fem.problem(
            problem.mesh,
            problem.material,
            kinematics=fem.Axisymmetric(),
            space=problem.space,
            supports=problem.supports,
            loads=(load,),
        )
    )
    assert moved == pytest.approx(float(still.displacement[skin, 0]), rel=0.01)
    assert moved > 1e-4
    clock.sleep_until(clock.now() + 0.8)
    assert abs(board.read_pressure()[0]) < 600 and board.board.state is State.VENTED


def test_the_solid_is_there_for_a_client_on_the_network(tube):
    """In real time, or in slow motion on a busy machine."""
    _, skin, _, (advance, start) = tube
    valves = ModelValves(advance, start, 1, noise=0.0)
    limits = settings(1, low=-10 * kPa, high=50 * kPa, watchdog=5.0)
    with serve(limits, valves) as server:
        begin, most = time.monotonic(), 0.0
        while most < 9 * kPa:
            assert time.monotonic() - begin < 60
            # frames that are too late on a busy machine
            with (
                contextlib.suppress(BoardFault, ConnectionError),
                TcpBoard(port=server.port, timeout=10.0) as board,
            ):
                board.arm()
                while most < 9 * kPa:
                    board.write_pressure(np.full(1, 10 * kPa))
                    most = max(most, board.report.pressure[0])
                    time.sleep(0.01)
        assert valves.state.state["body"]["u"][skin, 0] > 0
