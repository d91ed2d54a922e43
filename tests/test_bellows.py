"""The bellows actuator: reference case A, its drawing, and the gradient by its walls."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.bellows import PRESSURES, case_a, tip_errors
from sorojax import fem, mesh, sdf
from sorojax.cli.demo import design as designs
from sorojax.robots import BellowsActuator
from sorojax.units import kPa, mm


@pytest.fixture(scope="module")
def path():
    return fem.solve_path(case_a(0.7 * mm), air=jnp.asarray(PRESSURES))


def test_tip_lies_within_0_3_percent_of_the_converged_solution(path):
    assert tip_errors(path.problem, path.displacements)[1:].max() < 3e-3


def test_linear_pressures_are_taken_where_they_are_asked_for():
    assert isinstance(case_a(2 * mm, linear_pressure=True).formulation, fem.LinearPressure)
    assert isinstance(case_a(2 * mm).formulation, fem.Displacement)


def test_every_accepted_state_is_an_equilibrium_and_is_found_fast(path):
    steps = [step for stats in path.stats for step in stats.steps]
    assert max(step.residual for step in steps) < 1e-8
    assert sum(step.iterations for step in steps) <= 22
    u = path.displacements[-1]
    at_top = fem.with_load(path.problem, "air", path.values[-1])
    pushed = PRESSURES[-1] * 10 * mm  # on one wall of a chamber, per metre of depth [N]
    force = fem.reaction_force(at_top, u, at_top.supports[0].nodes)
    assert jnp.max(jnp.abs(force)) < 1e-8 * pushed


def test_mesh_area_is_that_of_the_drawing(path):
    drawn = float(sdf.area(BellowsActuator().body()))
    exact = 66 * 15 - (300 - 5 * (4 - math.pi)) - 4 * (3 * 12 - (2 - math.pi / 2))
    assert abs(drawn / (exact * mm**2) - 1) < 1e-4
    assert abs(float(jnp.sum(mesh.cell_areas(path.problem.mesh))) / drawn - 1) < 1e-3


def test_gradient_by_the_wall_thickness_agrees_with_central_differences():
    design = designs.draw(1.5 * mm)
    robot, flat = design.actuator, design.problem.mesh
    path = fem.solve_path(design.problem, air=jnp.array([8 * kPa]))
    ends = jnp.array([mesh.nearest_node(flat, [robot.length, y]) for y in (0.0, robot.height)])
    tight = fem.Newton(residual_tolerance=1e-12)

    def rotation(wall):
        drawn = dataclasses.replace(robot, wall_thickness=wall)
        moved = mesh.move(flat, drawn.body(), interfaces=(drawn.layer(),))
        problem = eqx.tree_at(lambda p: p.mesh.points, path.problem_at(-1), moved.points)
        solution = fem.solve(problem, start=path.displacements[-1], newton=tight)
        face = (moved.points + solution.displacement)[ends]
        across = face[1] - face[0]
        return jnp.arctan2(-across[0], across[1])

    wall, h = robot.wall_thickness, 10e-6
    at = {k: float(rotation(wall + k * h)) for k in (-2, -1, 1, 2)}
    difference = (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * h)
    assert abs(float(jax.grad(rotation)(wall)) / difference - 1) < 1e-6


def test_gradients_of_rotation_and_tracking_agree_with_central_differences():
    job = designs.Job(designs.draw(1.5 * mm), jnp.linspace(0.0, 8 * kPa, 7), 0.5)
    first = job.run(job.numbers)
    for slope in designs.sensitivities(job, first).values():
        assert slope.error < 1e-4
        assert all(np.isfinite(value) for value in slope.gradient.values())


def test_dimensions_that_leave_no_chamber_are_refused():
    with pytest.raises(ValueError, match="at least two fillets"):
        BellowsActuator(wall_thickness=4.5 * mm)
    with pytest.raises(ValueError, match="write 2 \\* mm"):
        BellowsActuator(wall_thickness=2.0)


def test_the_drawing_is_differentiable_in_every_dimension():
    point = jnp.array([12.5 * mm, 8 * mm])
    slopes = jax.grad(lambda a: a.body()(point))(BellowsActuator())
    leaves = jax.tree.leaves(slopes)
    assert all(jnp.isfinite(leaf) for leaf in leaves)
    assert abs(slopes.wall_thickness) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("size", "message"),
    [(1.0, "do not fit in a box"), (1e-9, "Raise `size`"), (float("nan"), "must be positive")],
)
def test_sizes_out_of_range_are_refused_at_once(size, message):
    with pytest.raises(ValueError, match=message):
        mesh.triangulate(BellowsActuator().body(), size=size)
