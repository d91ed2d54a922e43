"""The studies with rods give their numbers: impedance, shape sensing, gripping."""

import pytest

from tests.scripts import main_of, user_code


def test_a_tip_under_impedance_control_follows_a_wavy_wall():
    found = main_of("23_impedance")(quick=True)
    assert found["contact at [s]"] == pytest.approx(0.88, abs=0.1)
    assert found["tip off the projected set-point, sliding [mm]"] < 5
    assert found["the same at the end [mm]"] < 1
    asked = found["stiffness times offset [N]"]
    assert found["force at the end [N]"] == pytest.approx(asked, rel=0.05) and asked > 1
    assert found["overlap, greatest [mm]"] < 1
    assert found["effort at the switch over that before"] > 1.2


def test_a_shape_is_told_from_the_tip_under_pushes():
    found = main_of("24_shape_sensing")(quick=True)
    for case, most in (("6 kPa, 12 mN: ", 3), ("30 kPa, 60 mN: ", 12)):
        assert found[f"{case}error of the tip, largest [mm]"] < 1
        middle, alone = (
            f"{case}error of the middle",
            f"{case}error of the middle by the tip alone",
        )
        assert found[f"{middle}, largest [mm]"] < most
        for kind in ("largest", "mean"):
            assert found[f"{alone}, {kind} [mm]"] > 1.2 * found[f"{middle}, {kind} [mm]"]
        assert found[f"{case}way of the tip [mm]"] > 20
    median, rare = (
        f"time of an estimate, {kind} [ms]" for kind in ("median", "99th percentile")
    )
    assert 0 < found[median] < found[rare]


def test_fingers_hold_things_that_can_turn_and_turn_a_bolt():
    found = main_of("22_gripper")(quick=True)
    for thing in ("beaker", "wrench"):
        assert found[f"{thing}: contact forces over weight"] == pytest.approx(1, rel=0.01)
        assert abs(found[f"{thing}: sinks by [mm/s]"]) < 3
        assert found[f"{thing}: turned by [deg]"] < 6
    # held harder, a beaker twists the fingers; held less, a wrench falls
    turned = found["beaker: turned by [deg]"]
    assert found["beaker, 20 mN m: turned by [deg]"] > 4 * turned
    assert found["wrench, 20 mN m: contact forces over weight"] == 0
    left, right = (found[f"bolt {side}: turns a second"] for side in ("left", "right"))
    assert 0.12 < abs(left) < 0.25 and right == pytest.approx(-left, rel=0.02)
    for side in ("left", "right"):
        assert found[f"bolt {side}: way back, of a step [%]"] < 2
    assert user_code("22_gripper") <= 60
