"""Robots by their dimensions, and what searches found, drawn on what was searched."""

import jax.numpy as jnp
import numpy as np
import pytest

import sorojax as sj
from sorojax import fem, material, mesh as M, robots, rod as R, sdf, view
from sorojax.fem.stability.buckling import CriticalLoads
from sorojax.fem.stability.continuation import CriticalPoint
from sorojax.math.status import Status
from sorojax.mesh.repair import Repaired
from sorojax.rod.statics.equilibrium import Solution
from sorojax.rod.statics.path import Path
from sorojax.view import style
from sorojax.view.draw.robots import air_of, robot_scene
from sorojax.view.raster.scene import Surface
from tests.test_view_show import is_whole, near, patch, pixels, words


@pytest.fixture(scope="module", autouse=True)
def _own_renderer():
    """The same pictures with and without the extra, and no warning."""
    from sorojax.view.raster import solid

    before, solid._warned = solid._warned, True
    yield
    solid._warned = before


def rgb(colour):
    from matplotlib.colors import to_rgb

    return tuple(round(255 * c) for c in to_rgb(colour))


def test_a_flat_robot_shows_its_air_inside_its_body():
    robot = robots.BellowsActuator()
    shown = view.show(robot)
    image = pixels(shown)
    assert is_whole(shown) and "BellowsActuator" in words(shown) and "air" in words(shown)
    body, air = robot.body(), robot.chambers()
    lower, upper = (np.asarray(corner) for corner in body.bounding_box())
    points = np.random.default_rng(0).uniform(lower, upper, (400, 2))
    hollow, rubber = (np.asarray(f(jnp.asarray(points))) for f in (air, body))
    for inside, colour in ((hollow, style.COLOURS[5]), (rubber, style.BODY)):
        deep = points[inside < -0.4e-3][:20]
        seen = [near(patch(shown, image, p[None]), rgb(colour), 12).mean() for p in deep]
        assert len(deep) > 5 and np.mean(seen) > 0.9
    assert robot._repr_png_()[:4] == b"\x89PNG"


def test_a_solid_robot_is_clear_around_its_air():
    bellows = robots.Bellows(num_folds=2)
    air, body = robot_scene(bellows, size=1.6e-3).parts
    assert (air.name, body.opacity < 1) == ("air", True)
    assert np.ptp(air.points, axis=0).max() < np.ptp(body.points, axis=0).max()
    shown = view.show(bellows, size=1.6e-3, renderer="own")
    assert is_whole(shown) and near(pixels(shown), rgb(style.COLOURS[5]), 60).mean() > 0.02
    groups = air_of(robots.Crawler())
    assert list(groups) == ["air, rear", "air, middle", "air, front"]
    assert air_of(robots.Walker()) == {}


def test_buckling_is_drawn_on_the_body():
    mesh = M.rectangle([0.0, 0.0], [0.005, 0.06], divisions=(1, 12), order=2)
    problem = fem.problem(
        mesh,
        material.neo_hookean(young_modulus=1e5, poisson_ratio=0.4),
        kinematics=fem.PlaneStrain(0.02),
        supports=(fem.Fixed(mesh.node_sets["bottom"]),),
    )
    y = mesh.points[:, 1] / 0.06
    first = jnp.stack([y**2, 0 * y], axis=1)
    second = jnp.stack([jnp.sin(3 * y), 0 * y], axis=1)
    found = CriticalLoads(jnp.array([1.5, 4.0]), jnp.stack([first, second]))
    shown = view.show(found, problem=problem)
    assert is_whole(shown) and len(shown.panels) == 2
    assert "mode 1: load factor 1.5" in words(shown) and "4" in words(shown)
    tip = np.array([[0.0025, 0.06]]) + np.array([[0.12 * np.hypot(0.005, 0.06), 0.0]])
    inside = patch(shown, pixels(shown), tip - [0, 5e-4])
    assert near(inside, (253, 231, 37), 60).mean() > 0.3  # the largest amplitude
    point = CriticalPoint("bifurcation", jnp.array(1.2), 0 * mesh.points, first, 1)
    assert "bifurcation at load factor 1.2" in words(view.show(point, problem=problem))
    none = CriticalLoads(jnp.zeros(0), jnp.zeros((0, *mesh.points.shape)))
    with pytest.raises(ValueError, match="no critical load"):
        view.show(none, problem=problem)


def test_answers_of_rods_are_posed():
    arm = R.rod(
        sj.SE2(),
        R.chebyshev(kappa_z=2),
        R.circle(0.005),
        length=0.1,
        young_modulus=1e5,
        poisson_ratio=0.4,
        density=1e3,
        nodes=6,
    )
    q = jnp.array([8.0, 0.0])
    found = Solution(q, Status.successful, jnp.array(4), error=jnp.array(2e-6))
    shown = view.show(found, model=arm)
    assert is_whole(shown) and "error 2e-06" in words(shown)
    tip = np.asarray(R.forward_kinematics(arm, q, [0.97]))[0, :2, 2]
    assert near(patch(shown, pixels(shown), tip[None]), rgb(style.BODY)).mean() > 0.5
    rows = jnp.linspace(0, 1, 9)[:, None] * q[None]
    ones = jnp.ones(9, int)
    path = Path(rows, Status.successful, rows[:, 0], 0 * ones, ones)
    assert len(view.show(path, model=arm).figure.axes[0].patches) == 5


def test_a_rig_a_part_and_a_fit_are_shown():
    arm = R.rod(
        sj.SE3(),
        R.chebyshev(kappa_y=1),
        R.circle(0.008),
        length=0.1,
        young_modulus=1e5,
        poisson_ratio=0.4,
        density=1e3,
        nodes=6,
    )
    rig = view.rig(arm, around=8, stations=9)
    shown = view.show(rig, jnp.array([9.0]), view="front", renderer="own")
    tip = np.asarray(R.forward_kinematics(arm, jnp.array([9.0]), [0.97]))[0, :3, 3]
    assert is_whole(shown) and patch(shown, pixels(shown), tip[None]).max() < 240
    strain = np.linspace(0, 1, 11)
    fit = material.fit_tensile(strain, 1e5 * strain, model=material.NeoHookean)
    axes = view.show(fit, points=(strain, 1e5 * strain)).figure.axes[0]
    stretch, stress = axes.lines[1].get_data()
    assert (stretch[0], stretch[-1]) == (1.0, 2.0) and len(axes.lines[2].get_xdata()) == 11
    assert stress[-1] == pytest.approx(100, rel=0.4)
    flat = sdf.Rectangle([0.0, 0.0], [0.03, 0.01])
    repaired = Repaired(M.rectangle([0, 0], [1, 1], divisions=(2, 2)), *np.zeros((3, 0)))
    assert "8 cells Tri3" in words(view.show(repaired))
    assert isinstance(view.scene_of(flat).parts[0], Surface)


def test_records_stand_beside_their_predictions():
    from sorojax.design.calibration.calibration import Calibration, Check

    line, off = np.linspace(0, 1, 5), np.array([0.1, -0.1, np.nan, 0.1, -0.1])
    checks = [
        Check(name, line, off, rms, 0.05 * np.ones(5))
        for name, rms in (("pull", 1.1), ("push", 0.9))
    ]
    none = np.zeros(0)
    found = Calibration(
        {"E": jnp.array(1e5)},
        Status.successful,
        np.eye(1),
        4.0,
        3,
        ("E",),
        none > 0,
        none > 0,
        none,
        np.zeros((0, 1)),
        (checks[0],),
        (checks[1],),
        {},
        None,
    )
    shown = view.show(found)
    assert is_whole(shown) and "pull: 1.1 of the noise" in words(shown)
    assert "push, held out: 0.9" in words(shown)
    measured, predicted = shown.figure.axes[0].lines
    assert np.allclose(measured.get_ydata(), line - off, equal_nan=True)
    assert np.array_equal(predicted.get_ydata(), line)
