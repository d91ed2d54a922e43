"""The device protocols, the loop and the board in memory."""

import equinox as eqx
import numpy as np
import pytest

from sorojax.cli.demo.design import controller, reference_angle
from sorojax_hardware import (
    Clock,
    MemoryBoard,
    SimulatedClock,
    ValveBoard,
    WallClock,
    deadlines,
    run_loop,
)

kPa = 1e3
PERIOD = 0.01


def proportional_integral(target, proportional=0.5, integral=8.0):
    def controller(t, measurement, state):
        error = target - measurement
        state = state + error * PERIOD
        return proportional * error + integral * state, state

    return controller


def desk(num_ports=2, **options):
    clock = SimulatedClock()
    return clock, MemoryBoard(clock, num_ports, **options)


def loop(
    board, clock, controller, state=0.0, duration=1.0, limits=(-10 * kPa, 60 * kPa), **how
):
    return run_loop(
        board, clock, controller, state, duration=duration, period=PERIOD, limits=limits, **how
    )


def test_devices_fit_their_protocols():
    clock, board = desk()
    assert isinstance(board, ValveBoard)
    assert isinstance(clock, Clock) and isinstance(WallClock(), Clock)
    assert not isinstance(object(), ValveBoard)


def test_board_is_a_first_order_lag():
    clock, board = desk(time_constant=np.array([0.03, 0.1]))
    board.write_pressure(np.full(2, 50 * kPa))
    clock.sleep_until(0.06)
    want = 50 * kPa * (1 - np.exp([-2.0, -0.6]))
    assert np.allclose(board.read_pressure(), want, rtol=1e-12)
    assert np.allclose(board.read_pressure(), want, rtol=1e-12)  # no time, no change


def test_pi_controller_reaches_its_target_and_the_board_vents():
    clock, board = desk()
    target = np.array([20 * kPa, 40 * kPa])
    ticks = list(loop(board, clock, proportional_integral(target), np.zeros(2), 3.0))
    assert len(ticks) == 300
    assert np.allclose(ticks[-1].pressure, target, rtol=1e-3)
    assert np.all(board.setpoint == 0)


@pytest.mark.versions
def test_the_controller_of_the_demo_runs_on_the_board():
    """The PID that `sorojax demo` simulates, angle in and pressure out, without a change."""
    clock, board = desk(num_ports=1)
    full, top = np.radians(-77.0), 20 * kPa
    target = reference_angle(full, 5.0)
    pid = controller(full, top, target)
    ticks = run_loop(
        board,
        clock,
        eqx.filter_jit(pid),
        pid.start(0.0, 0.0),
        duration=5.0,
        period=PERIOD,
        limits=(0.0, 1.2 * top),
        measure=lambda t, pressure: full / top * pressure[0],  # rad, of a slow actuator
    )
    angles = [full / top * tick.pressure[0] for tick in ticks]
    assert len(angles) == 500 and abs(angles[-1] / (0.8 * full) - 1) < 5e-3
    assert abs(angles[220] / (0.6 * full) - 1) < 5e-3  # at rest between two moves
    assert np.all(board.setpoint == 0)


@pytest.mark.stress(53)
def test_commands_are_cut_to_the_limits():
    clock, board = desk()
    low, high = np.array([-10 * kPa, 0.0]), np.array([30 * kPa, 5 * kPa])
    up = [t.setpoint for t in loop(board, clock, lambda t, y, s: (1e9, s), limits=(low, high))]
    down = [
        t.setpoint for t in loop(board, clock, lambda t, y, s: (-1e9, s), limits=(low, high))
    ]
    assert np.all(np.array(up) == high) and np.all(np.array(down) == low)


def test_board_cuts_to_its_own_limits():
    _, board = desk()
    board.write_pressure(np.array([150 * kPa, -20 * kPa]))
    assert np.array_equal(board.setpoint, [100 * kPa, -20 * kPa])
    assert np.array_equal(board.clipped, [True, False])


@pytest.mark.parametrize("wrong", [np.array([np.nan, 0.0]), np.zeros(3)])
@pytest.mark.stress(53)
def test_board_refuses_what_is_no_setpoint_and_keeps_the_last(wrong):
    _, board = desk()
    board.write_pressure(np.full(2, 5 * kPa))
    with pytest.raises(ValueError, match="need"):
        board.write_pressure(wrong)
    assert np.all(board.setpoint == 5 * kPa)


def test_board_vents_when_the_controller_raises():
    clock, board = desk()

    def fails(t, measurement, state):
        if t > 0.5:
            raise RuntimeError("sensor lost")
        return 30 * kPa, state

    ticks = loop(board, clock, fails)
    assert np.all(next(ticks).setpoint == 30 * kPa)
    assert np.all(board.setpoint == 30 * kPa)
    with pytest.raises(RuntimeError, match="sensor lost"):
        list(ticks)
    assert np.all(board.setpoint == 0)


def test_board_vents_when_the_loop_is_left():
    clock, board = desk()
    ticks = loop(board, clock, lambda t, y, s: (30 * kPa, s))
    next(ticks)
    ticks.close()
    assert np.all(board.setpoint == 0)


@pytest.mark.stress(53)
def test_a_command_that_is_not_finite_ends_the_loop_vented():
    clock, board = desk()
    with pytest.raises(ValueError, match="2 finite pressures"):
        list(loop(board, clock, lambda t, y, s: (np.nan, s)))
    assert np.all(board.setpoint == 0)


@pytest.mark.parametrize("wrong", [{"period": 0.0}, {"duration": -1.0}, {"limits": (1.0, 0.0)}])
def test_wrong_settings_raise_at_the_call(wrong):
    clock, board = desk()
    options = {"duration": 1.0, "period": PERIOD, "limits": (0.0, 1.0)} | wrong
    with pytest.raises(ValueError, match="run_loop"):
        run_loop(board, clock, lambda t, y, s: (0.0, s), None, **options)


@pytest.mark.parametrize(("catch_up", "made_up"), [(3, True), (2, False), (0, False)])
def test_an_overrun_is_made_up_for_or_left_out(catch_up, made_up):
    """A stall of 3.5 periods: three ticks begin late, one after another, or never."""
    clock, board = desk()

    def slow_once(t, measurement, calls):
        if calls == 10:
            clock.sleep_until(clock.now() + 0.035)
        return 0.0, calls + 1

    ticks = list(loop(board, clock, slow_once, 0, catch_up=catch_up))
    report = deadlines(ticks, PERIOD)
    assert report.num_ticks == (100 if made_up else 97)
    assert report.num_skipped == 100 - report.num_ticks
    late = [0.025, 0.015, 0.005, 0.0] if made_up else [0.0] * 4
    assert np.allclose([tick.late for tick in ticks[11:15]], late, atol=1e-9)
    assert report.num_behind == (2 if made_up else 0)


def test_a_loop_that_is_always_too_slow_stays_within_its_bound():
    clock, board = desk()

    def slow(t, measurement, state):
        clock.sleep_until(clock.now() + 1.5 * PERIOD)
        return 0.0, state

    ticks = list(loop(board, clock, slow, None, catch_up=2))
    assert 60 < len(ticks) < 70 and max(tick.late for tick in ticks) < 3 * PERIOD


def test_wall_clock_waits():
    clock = WallClock()
    start = clock.now()
    clock.sleep_until(start + 0.02)
    assert 0.02 <= clock.now() - start < 1.0
