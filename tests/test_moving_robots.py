"""Robots that move by themselves: drawings, meshes, gait, and where they stand."""

import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import fem, mesh, robots, sdf
from sorojax.fem.loads.facets import areas_of
from sorojax.robots.locomotion import PORTS, crawler_mesh
from sorojax.units import kPa, mm
from tests.scripts import main_of


def test_the_mesh_of_the_crawler_is_its_drawing():
    crawler = robots.Crawler(num_chambers=9)
    cells = crawler_mesh(crawler, 3 * mm)
    drawn = float(sdf.area(crawler.body()))
    assert float(jnp.sum(mesh.cell_areas(cells))) == pytest.approx(drawn, rel=1e-4)
    sole = float(jnp.sum(mesh.cell_areas(cells)[cells.regions["sole"]]))
    assert sole == pytest.approx(150 * mm * 2 * mm, rel=1e-9)
    halved = crawler_mesh(crawler, 1.5 * mm, across=2)
    assert halved.num_cells == 4 * cells.num_cells
    problem = robots.crawler_problem(crawler, size=3 * mm, depth=1.0)
    air = 9 * 3.22 * mm * 8.4 * mm
    zero = jnp.zeros_like(cells.points)
    for load in problem.loads[1:-1]:
        assert isinstance(load, fem.Pressure)
        assert load.potential(problem, zero) == 0.0
        push = fem.with_load(problem, load.name, 1.0)
        volume = -[x for x in push.loads if x.name == load.name][0].potential(push, zero)
        assert float(volume) == pytest.approx(air, rel=1e-9)
    floor = problem.loads[-1]
    assert isinstance(floor, fem.Contact)
    assert float(floor.points_of(problem, zero)[..., 1].min()) == 0.0


@pytest.mark.parametrize("groups", [1, 2, 3])
def test_a_crawler_may_stand_on_feet(groups):
    length = (50 * groups + 10) * mm
    crawler = robots.Crawler(length, num_groups=groups, num_chambers=9, foot_height=2 * mm)
    cells = crawler_mesh(crawler, 3 * mm)
    assert float(jnp.sum(mesh.cell_areas(cells))) == pytest.approx(
        float(sdf.area(crawler.body())), rel=1e-4
    )
    feet = crawler.feet()
    wide = float(jnp.sum(feet[:, 1] - feet[:, 0]))
    sole = float(jnp.sum(mesh.cell_areas(cells)[cells.regions["sole"]]))
    assert sole == pytest.approx(2 * mm * (float(length) + wide), rel=1e-9)
    problem = robots.crawler_problem(crawler, size=3 * mm)
    names = [load.name for load in problem.loads]
    assert names == ["gravity", *crawler.ports, "floor"] and len(feet) == groups + 1
    floor = problem.loads[-1]
    assert isinstance(floor, fem.Contact)
    x, y = np.moveaxis(np.asarray(floor.points_of(problem, 0 * cells.points)), -1, 0)
    on_floor = x[(y < 1e-9) & (x > 1e-9) & (x < length - 1e-9)]
    stands = [np.any((a < on_floor) & (on_floor < b)) for a, b in np.asarray(feet)]
    inside = [
        np.any((on_floor > a) & (on_floor < b))
        for a, b in zip(feet[:-1, 1], feet[1:, 0], strict=True)
    ]
    assert all(stands) and not any(inside)
    assert np.ptp(y) == pytest.approx(2 * mm, rel=1e-3)
    between = areas_of(problem, floor.facets)[y > (2 - 1e-6) * mm]  # holds up what sags
    assert np.sum(between) == pytest.approx(40 * mm * (float(length) - wide))
    assert tuple(robots.crawler_gait(ports=crawler.ports)) == crawler.ports


def test_a_crawler_has_at_most_three_groups():
    with pytest.raises(ValueError, match="got 4 for `num_groups`"):
        robots.Crawler(num_groups=4)
    with pytest.raises(ValueError, match="foot_height"):
        robots.Crawler(foot_height=-1 * mm)


def test_the_gait_is_a_row_of_half_waves():
    gait = robots.crawler_gait(8 * kPa, 2.0, np.pi / 3)
    assert tuple(gait) == PORTS
    t = jnp.linspace(0, 0.5, 601)
    waves = np.stack([np.asarray(gait[name](t)) for name in PORTS])
    assert waves.min() == 0.0 and np.allclose(waves.max(axis=1), 8 * kPa, rtol=1e-4)
    peaks = np.asarray(t)[waves.argmax(axis=1)]
    assert np.allclose(np.diff(peaks), 0.5 / 6, atol=1e-3)  # a sixth of the period


def test_crawlers_without_room_are_refused():
    with pytest.raises(ValueError, match="between groups"):
        robots.Crawler(num_chambers=13)
    with pytest.raises(ValueError, match="metres"):
        robots.Crawler(height=12.0)


def test_the_walker_stands_on_all_its_feet():
    walker = robots.Walker(num_pairs=2)
    problem = robots.walker_problem(walker, size=1.6 * mm)
    cells, floor = problem.mesh, problem.loads[-1]
    assert isinstance(floor, fem.Contact)
    zero = jnp.zeros_like(cells.points)
    points = np.asarray(floor.points_of(problem, zero)).reshape(-1, 2)
    for foot in np.asarray(walker.bottoms()):
        near = points[np.abs(points[:, 0] - foot[0]) < 0.3 * mm]
        assert -1e-9 < near[:, 1].min() < 0.05 * mm
    assert float(cells.points[:, 1].min()) == pytest.approx(0.0, abs=1e-3 * mm)
    assert np.allclose(robots.pair_angles(walker, cells, zero[None]), np.pi / 2, atol=0.1)
    assert float(problem.loads[0].value[0]) == pytest.approx(9.81 / 2)


def test_the_walker_finds_one_rhythm_for_its_legs():
    numbers = main_of("20_passive_walker")(quick=True)
    assert 19 < numbers["frequency of the gait [Hz]"] < 23
    assert numbers["frequencies apart [Hz]"] < 1.5  # a record of 0.2 s tells no more
    assert numbers["a period like the one before"] > 0.9
    assert numbers["swing of the legs [deg]"] > 3
    assert numbers["step of the front foot [mm]"] > 1
    assert numbers["slip back of the front foot [mm]"] < 0.5
    assert numbers["cut steps"] == 0
