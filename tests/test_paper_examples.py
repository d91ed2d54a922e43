"""The worked examples of the Sorotoki paper give their numbers, in quick mode."""

import pytest

from tests.scripts import ROOT, main_of, user_code

LONGEST = 60  # lines of user code


def test_examples_are_short():
    names = sorted(path.stem for path in (ROOT / "examples").glob("[0-9]*.py"))
    lengths = {name: user_code(name) for name in names}
    assert len(lengths) > 10 and min(lengths.values()) > 10
    assert {n: k for n, k in lengths.items() if k > LONGEST} == {}


def test_shapes_are_cut_and_fit_to_print():
    numbers = main_of("10_sdf_algebra")(quick=True)
    assert abs(numbers["area over its exact value, less 1"]) < 1e-5
    assert numbers["field off the distance inside [mm]"] < 0.01
    assert numbers["slope off one"] < 1e-12
    assert numbers["points off the surface [mm]"] < 1e-12
    assert numbers["fit to print"] == 1
    assert numbers["volume of the triangles over the exact value"] == pytest.approx(1, abs=0.01)


def test_lloyd_evens_the_cells():
    numbers = main_of("11_voronoi")(quick=True)
    spread = [value for name, value in numbers.items() if name.startswith("spread")]
    assert spread == sorted(spread, reverse=True) and spread[-1] < 0.15 < spread[0]
    assert numbers["cells"] == 150
    assert numbers["largest angle of a cell [deg]"] < 180
    assert numbers["nodes outside the shape [mm]"] < 1e-3
    assert numbers["area of the cells off that of the shape"] < 0.005
    first, last = (numbers[f"shift of the seeds, {which} step"] for which in ("first", "last"))
    assert last < 0.1 * first


def test_the_holed_square_buckles_into_ellipses():
    numbers = main_of("12_buckling")(quick=True)
    assert numbers["critical strain, columns leaning"] == pytest.approx(0.0859, rel=0.01)
    assert 0.98 * 0.0843 < numbers["critical strain, ellipses"] < 1.02 * 0.0843
    assert numbers["critical strain, ellipses"] < numbers["critical strain, columns leaning"]
    assert numbers["alternation of the first mode, 12.5 %"] > 0.95
    assert numbers["alternation of the first four, 0 %"] < 0.5
    assert (
        numbers["unstable modes kept at 12.5 %"] > 0 == numbers["unstable modes past buckling"]
    )
    assert numbers["Poisson's ratio, 0 to 2 %"] > 0.3
    assert numbers["Poisson's ratio beyond 10 %"] < -0.5


def test_a_crawler_walks_at_the_pressure_of_the_paper():
    numbers = main_of("04_crawler")(quick=True)
    assert 5.5 < numbers["way of the last cycle [mm]"] < 7
    assert 15 < numbers["highest lift of its centre [mm]"] < 22
    assert 0 <= numbers["overlap with the floor [mm]"] < 0.1
    assert 8 < numbers["rubbers of the paper: burst at [kPa]"] < 20  # far below 45
    assert numbers["rubbers of the paper: longest stretch then"] > 4
    assert user_code("04_crawler") <= 60


def test_modes_of_a_pneunet_show_its_chambers():
    numbers = main_of("13_pneunet_basis")(quick=True)
    assert numbers["modes off orthonormal"] < 1e-10
    assert numbers["waves of the first mode along the chambers"] == 6  # all of them
    assert numbers["mean distance of the backbones, worst [mm]"] < 1
    assert 0 < numbers["overlap with the cylinder [mm]"] < 0.05
    assert 0 < numbers["overlap of the walls [mm]"] < 0.05


def test_six_fingers_lie_on_the_ball():
    numbers = main_of("14_jellyfish")(quick=True)
    assert numbers["fingers on the ball"] == 6
    assert numbers["penetration [mm]"] < 0.1
    assert numbers["farthest off the ball, outer 40 % [mm]"] < 0.5
    assert numbers["tips apart [mm]"] > 4.5  # wider than a finger


def test_the_fingers_of_a_hand_follow_each_other():
    numbers = main_of("15_soft_hand")(quick=True)
    assert numbers["a finger behind the one before [deg]"] == pytest.approx(30, abs=1)
    assert numbers["fingers of one length differ by [deg]"] < 2
    assert numbers["first finger behind the thumb [deg]"] == pytest.approx(30, abs=3)
    assert 90 < numbers["swing of the tip [deg]"] < 160
    assert 80 < numbers["highest pressure [kPa]"] < 95
    assert 2 < numbers["flow that fills the growing finger [%]"] < 20


def test_a_gripper_carries_a_cylinder_to_its_place():
    numbers = main_of("16_pick_and_place")(quick=True)
    assert numbers["lift [mm]"] > 8
    assert numbers["contact forces over weight, carried"] == pytest.approx(1, abs=0.01)
    assert numbers["moved in the grip [mm]"] < 0.5
    assert numbers["place off its target [mm]"] < 1.5
    assert numbers["tilt at the end [deg]"] < 0.1 and numbers["farthest tilt [deg]"] > 10
    assert numbers["speed at the end [mm/s]"] < 0.1
    assert 0 < numbers["overlap with fingers, greatest [mm]"] < 0.1
    assert 0 < numbers["overlap with the floor, greatest [mm]"] < 0.1
    assert numbers["gripper lets go [mm]"] > 0.5


def test_a_chamber_that_nobody_drew_is_wide_below_and_bends():
    numbers = main_of("21_pneunet_topology")(quick=True)
    assert (
        numbers["output of the cell [mm]"] > 1.5 * numbers["output of the cell at first [mm]"]
    )
    assert numbers["volume over the largest allowed"] == pytest.approx(1, abs=0.02)
    assert numbers["grey measure"] < 0.05
    assert numbers["widest part of the chamber, share of its height"] < 0.5
    assert numbers["width, lower over upper third"] > 1.2
    upside_down = numbers["output of the chamber upside down [mm]"]
    assert 0.9 < upside_down / numbers["output of the cell [mm]"] < 1
    assert numbers["finer mesh off the first [mm]"] < 2
    assert numbers["tip moves by [mm]"] > 3
    assert numbers["watertight"]
    for name in ("", "plain, same air: ", "plain, thinnest sides: "):
        some, more = (numbers[f"{name}tip turns {x} [deg]"] for x in ("at 20 kPa", "by"))
        assert 0 < 2 * some < more
