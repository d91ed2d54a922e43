"""Stress cases of finite elements that hit shapes, each other and themselves in long steps."""

from functools import partial

import pytest

from benchmarks.cases.contact_solids import impact, on_a_plate, on_a_shape, on_itself


@pytest.mark.stress(88)
@pytest.mark.parametrize(
    ("scene", "speed", "wall", "step"),
    [(on_a_plate, 20.0, 5.0, 1e-3), (on_itself, 20.0, 5.0, 1e-3)],
)
def test_surfaces_do_not_jump_over_each_other(scene, speed, wall, step):
    left, most = impact(scene, speed, wall, step)
    assert left > 0 and most < 1.001


@pytest.mark.stress(89)
@pytest.mark.parametrize(
    ("scene", "speed", "wall", "step"),
    [
        (on_a_shape, 5.0, 5.0, 2e-4),
        (on_a_plate, 20.0, 5.0, 2e-5),
        (on_itself, 20.0, 20.0, 2e-4),
    ],
)
def test_a_solid_gains_no_energy_from_an_impact(scene, speed, wall, step):
    left, most = impact(scene, speed, wall, step)
    assert left > 0 and most < 1.001


@pytest.mark.stress(95)
@pytest.mark.parametrize("friction", [0.3, 0.8])
@pytest.mark.parametrize("step", [2e-4, 1e-3])
def test_a_solid_gains_no_energy_from_an_oblique_impact(friction, step):
    left, most = impact(partial(on_a_shape, friction=friction), 10.0, 5.0, step)
    assert left > 0 and most < 1.001
