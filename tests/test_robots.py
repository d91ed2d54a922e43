"""Printable robots: files that read back watertight, chambers inside, sane dimensions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import io, robots, sdf
from sorojax.units import mm

evaluate = eqx.filter_jit(lambda shape, p: shape(p))
EXTENTS = {  # mm
    robots.BendingActuator: (80, 20, 18),
    robots.PlanarActuator: (50, 24, 67),
    robots.Hand: (141, 190, 26),
    robots.Manipulator: (74, 74, 137),
}


# Handles: gaps between the folds and the spine that joins them, 7 on each of four fingers and
# 5 on the thumb, the others lie in the palm, and 5 on each of the gripper's three; loops of
# two plates and two or three bellows; the core through two plates and the ring of air.
GENUS = {
    robots.BendingActuator: 0,
    robots.PlanarActuator: 1,
    robots.Hand: 4 * 7 + 5,
    robots.Manipulator: 3 * 5 + 2 + 2 + 1,
}


@pytest.mark.parametrize("kind", EXTENTS)
def test_bodies_read_back_watertight(kind, tmp_path):
    body = kind().body()
    # a gap of the manipulator is thinner than the 1.2 mm that the others are cut at
    size = 1.0 * mm if kind is robots.Manipulator else 1.2 * mm
    # both ways of one body: the larger ones are compiled for seconds (benchmark robots.stl)
    both = ("marching_cubes", "dual_contouring")
    for method in both if kind is robots.PlanarActuator else both[1:]:
        surface = sdf.isosurface(body, size, method)
        io.export_surface(tmp_path / "body.stl", surface)
        back = io.import_surface(tmp_path / "body.stl")
        report = sdf.surface_report(back)
        assert report.watertight, (method, report)
        assert report.genus == GENUS[kind] and report.num_shells == 1
        assert method == "marching_cubes" or not len(report.crossings)
        assert len(back.triangles) == len(surface.triangles)
        extent = np.ptp(back.vertices, axis=0) / mm
        assert np.allclose(extent, EXTENTS[kind], rtol=0, atol=1.0)


@pytest.mark.parametrize("kind", EXTENTS)
def test_chambers_are_no_part_of_the_body(kind, getkey):
    robot = kind()
    air, body = robot.chambers(), robot.body()
    lower, upper = (np.asarray(corner) for corner in body.bounding_box())
    p = jax.random.uniform(getkey(), (20000, 3), minval=lower, maxval=upper)
    inside, solid = (np.asarray(evaluate(shape, p)) for shape in (air, body))
    assert (inside < 0).any() and (solid < 0).any()
    assert not np.any((inside < -1e-9) & (solid < -1e-9))


@pytest.mark.parametrize("wall", [1.6, 1.1])
def test_air_of_the_bending_actuator_is_a_wall_away_from_the_outside(wall, getkey):
    part = robots.BendingActuator(wall_thickness=wall * mm)
    lower, upper = (np.array(corner) for corner in part.solid().bounding_box())
    lower[0] += 3 * mm  # past the opening
    p = jax.random.uniform(getkey(), (200_000, 3), minval=lower, maxval=upper)
    deep = -np.asarray(evaluate(part.solid(), p))[np.asarray(evaluate(part.chambers(), p)) < 0]
    assert wall * mm - 1e-12 < deep.min() < 1.02 * wall * mm


def test_triangles_of_one_plane_do_not_cross():
    """Two of the side of a finger as a file rounds them; and one that does pass through."""
    points = np.array([
        [-0.03869514, 0.111315, -0.000685], [-0.03872134, 0.111815, -0.000685],
        [-0.03877133, 0.111815, -0.000185], [-0.03866893, 0.110815, -0.000685],
        [-0.03874512, 0.111315, -0.000185], [-0.03871892, 0.110815, -0.000185],
    ], np.float32).astype(float)  # fmt: skip
    both = np.array([[0, 1, 2], [3, 4, 5]])
    assert len(sdf.surface_report(sdf.Surface(points, both)).crossings) == 0
    away = np.array([[-1e-4, 0, 0], [1e-4, 1e-5, 0], [1e-4, 0, 1e-5]])
    through = points[:3].mean(axis=0) + away
    crossed = sdf.Surface(np.concatenate([points[:3], through]), both)
    assert sdf.surface_report(crossed).crossings.tolist() == [[0, 1]]


@pytest.mark.versions
def test_bellows_wall():
    part = robots.Bellows()
    z = part.cap + part.pitch * jnp.array([0.5, 1.5, 2.5])
    crest = jnp.stack([0 * z + part.outer_radius, 0 * z, z], axis=-1)
    assert jnp.allclose(part.solid()(crest), 0, atol=1e-9)
    assert jnp.allclose(part.chamber()(crest), part.wall_thickness, atol=1e-9)


@pytest.mark.versions
def test_volume_follows_a_dimension():
    def volume(length):
        return sdf.volume(robots.Hand(palm_length=length).palm(), 64)

    slope = jax.grad(volume)(jnp.array(114 * mm))
    # A longer palm grows by its section: 90 x 26 mm with corners of 8 mm.
    assert abs(float(slope) / ((90 * 26 - (4 - np.pi) * 64) * mm**2) - 1) < 5e-3


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: robots.BendingActuator(wall_thickness=4.5 * mm), "chambers are"),
        (lambda: robots.BendingActuator(width=20.0), "2 \\* mm"),
        (lambda: robots.PlanarActuator(spacing=20 * mm), "overlap"),
        (lambda: robots.Manipulator(center_distance=14 * mm), "overlap"),
        (lambda: robots.Bellows(fold_height=2 * mm), "two walls"),
    ],
)
def test_bad_dimensions_name_the_remedy(make, message):
    with pytest.raises(ValueError, match=message):
        make()
