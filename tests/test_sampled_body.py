"""Reduced bodies whose force comes from a few weighted cells: exact with all of them, close
with few, and what they refuse."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import fem, io, material, mesh, systems
from sorojax.math.status import Status
from sorojax.systems.blocks.modal_body import ProjectedForce
from sorojax.systems.blocks.sampled_body import (
    _equilibria,
    _error,
    snapshot_basis,
    sparse_weights,
)
from sorojax.systems.blocks.sampled_force import pieces, sampled_force

PUSH = jnp.stack([jnp.zeros(9), -jnp.linspace(0, 0.2, 9)], axis=1)  # N


def beam(formulation=None, relaxation=None, kinematics=None) -> systems.FemBody:
    """A cantilever in the plane, its free end driven by a force, under its weight."""
    cells = mesh.rectangle([0, 0], [0.08, 0.01], divisions=(16, 2), element=mesh.Quad8())
    rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.4, density=1000.0)
    stiffer = np.where(np.arange(cells.num_cells) % 2, 1.0, 1.5)
    law = material.Scaled(rubber, stiffer)
    problem = fem.problem(
        cells,
        law if relaxation is None else material.Viscoelastic(law, relaxation),
        kinematics=kinematics or fem.PlaneStrain(0.01),
        supports=(fem.Fixed(cells.node_sets["left"]),),
        loads=(
            fem.Force(cells.node_sets["right"], [0.0, 0.0], name="push"),
            fem.Gravity([0.0, -9.81]),
        ),
        formulation=formulation,
    )
    return systems.FemBody(problem, driven=("push",))


@functools.cache
def trained() -> systems.SampledBody:
    return systems.sampled_body(beam(), [{"push": PUSH}], modes=6, tolerance=5e-3)


RELAXING = material.Prony([0.4, 0.2], [0.02, 0.2])


@functools.cache
def relaxing() -> systems.SampledBody:
    body = beam(relaxation=RELAXING)
    return systems.sampled_body(body, [{"push": PUSH}], modes=8, tolerance=5e-3)


@pytest.mark.parametrize("formulation", [fem.Displacement(), fem.ConstantPressure()])
def test_all_cells_make_the_projected_force(formulation):
    body = beam(formulation)
    draw = np.random.default_rng(0)
    points = body.problem.mesh.points
    field = jnp.asarray(1e-3 * draw.normal(size=(5, *points.shape)))
    basis = snapshot_basis(body, field.at[:, body.problem.supports[0].nodes].set(0.0), 6)
    cells, points = pieces(body)
    assert (points is None) == isinstance(formulation, fem.ConstantPressure)
    got = sampled_force(body, basis, cells, np.ones(len(cells)), points)
    want = ProjectedForce(body.problem, basis)
    q = 1e-5 * jnp.asarray(draw.normal(size=len(basis)))
    size = float(jnp.max(jnp.abs(want(q))))
    np.testing.assert_allclose(got(q), want(q), atol=1e-11 * size)
    np.testing.assert_allclose(got.energy(q), want.energy(q), rtol=1e-9)
    np.testing.assert_allclose(jax.grad(got.energy)(q), got(q), atol=1e-11 * size)
    slope, hessian = jax.jacfwd(got)(q), jax.hessian(got.energy)(q)
    np.testing.assert_allclose(slope, hessian, atol=1e-10 * float(jnp.max(jnp.abs(hessian))))
    np.testing.assert_allclose(jax.jacrev(got)(q), hessian, atol=1e-10 * float(jnp.max(slope)))


def test_few_cells_find_equilibria_that_were_not_trained_on():
    found = trained()
    assert found.share < 0.1
    assert np.all(np.asarray(found.weights) > 0)
    assert found.training_error <= 5e-3
    assert found.error < 1e-2
    kept = len(np.unique(found.cells))
    assert (
        f"{found.share:.1%} of the quadrature points, in {kept} of {found.num_cells}"
        in repr(found)
    )


@pytest.mark.parametrize(
    ("full", "small", "times", "off"),
    [
        (beam, trained, {"duration": 0.05, "save": 6, "step": 1e-3}, 0.02),
        (
            functools.partial(beam, relaxation=RELAXING),
            relaxing,
            {"duration": 0.4, "save": 41, "step": 5e-4},
            0.01,
        ),
    ],
    ids=["elastic", "relaxing"],
)
def test_it_follows_the_full_body_in_a_network(full, small, times, off):
    """Whose end is pushed to and fro, less than in training."""
    push = systems.Source(systems.Sine([0.0, -0.12], 5.0), unit="N")
    films = []
    for block, solver in (
        (full(), systems.Coupled()),
        (small().body, systems.Rosenbrock2(refresh=True)),
    ):
        network = systems.Network({"body": block, "push": push}, {"body.push": "push.value"})
        films.append(systems.simulate(network, solver=solver, **times))
    want = films[0].state["body"]["u"]
    basis = small().body.basis
    got = jax.vmap(lambda q: systems.displacement(basis, q))(films[1].state["body"]["q"])
    assert jnp.max(jnp.abs(got - want)) < off * jnp.max(jnp.abs(want))


def test_branches_have_no_force_where_they_have_relaxed():
    body: Any = relaxing().body
    q = jnp.zeros_like(body.q).at[:2].set(jnp.array([3e-4, 2e-5]))
    rest, away = jnp.stack([q, q]), jnp.stack([0.5 * q, -0.3 * q])
    force, size = body.force, float(jnp.max(jnp.abs(body.force(q))))
    assert size > 0
    np.testing.assert_allclose(force.with_branches(q, rest), force(q), atol=1e-10 * size)
    assert abs(float(force.stored_by_branches(q, rest))) < 1e-12
    stored = jax.jacfwd(force.stored_by_branches)(q, away)
    np.testing.assert_allclose(
        force.with_branches(q, away) - force(q), stored, atol=1e-9 * size
    )
    found = jax.jacfwd(force.with_branches, (0, 1))(q, away)
    want = jax.jacfwd(jax.jacrev(force.stored_by_branches), (0, 1))(q, away)
    want = want[0] + jax.jacfwd(force)(q), want[1]
    for a, b in zip(found, want, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9 * float(jnp.max(jnp.abs(b))))


@pytest.mark.parametrize(
    ("most", "ends"), [(0.12, Status.successful), (0.6, Status.outside_model)]
)
def test_a_motion_far_outside_of_the_training_is_named(most, ends):
    """Pushed to 0.2 N in training."""
    rise = systems.Sine([0.0, -most], 5.0)  # to its largest at 0.05 s
    network = systems.Network(
        {"body": trained().body, "push": systems.Source(rise, unit="N")},
        {"body.push": "push.value"},
    )
    solver = systems.Rosenbrock2(refresh=True)
    film = systems.simulate(network, 0.05, save=6, step=1e-3, solver=solver, throw=False)
    assert film.status == ends
    assert (float(jnp.max(film["body.reach"])) > 1.25) == (ends == Status.outside_model)


def test_the_derivative_by_the_stiffness_is_that_of_differences():
    body: Any = trained().body
    q = 1e-4 * jnp.arange(1.0, 1 + len(body.basis)) * body.q.at[0].set(1.0)

    def energy(scale):
        stiff = body.force.body.material.base.shear_modulus * scale
        at = eqx.tree_at(lambda f: f.body.material.base.shear_modulus, body.force, stiff)
        return at.energy(q) + jnp.sum(at(q)) * q[0]

    slope = jax.grad(energy)(1.0)
    h = 1e-4
    np.testing.assert_allclose(slope, (energy(1 + h) - energy(1 - h)) / (2 * h), rtol=1e-8)


def test_weights_of_repeated_columns_are_found():
    """Three kinds of columns, many of each: one of each and its number would do."""
    draw = np.random.default_rng(0)
    kinds, counts = draw.uniform(0.1, 1.0, (12, 3)), (5, 9, 2)
    rows = np.repeat(kinds, counts, axis=1)
    cells, weights, left = sparse_weights(rows, rows.sum(axis=1), 1e-9)
    assert len(cells) == 3 and left < 1e-9
    np.testing.assert_allclose(np.sort(weights), np.sort(counts), rtol=1e-6)


def test_weights_stop_at_the_tolerance_and_are_positive():
    rows = np.random.default_rng(1).normal(size=(40, 200)) + 0.3
    found = [
        sparse_weights(rows, rows.sum(axis=1), tolerance) for tolerance in (0.3, 0.1, 0.03)
    ]
    assert len(found[0][0]) < len(found[1][0]) < len(found[2][0])
    for (cells, weights, left), tolerance in zip(found, (0.3, 0.1, 0.03), strict=True):
        assert left <= tolerance and (weights > 0).all()
        want = rows.sum(axis=1)
        gap = np.linalg.norm(rows[:, cells] @ weights - want) / np.linalg.norm(want)
        np.testing.assert_allclose(gap, left, atol=1e-12)


@pytest.mark.parametrize(
    ("path", "modes", "text"),
    [
        ({"pull": PUSH}, 6, "need one driven load of \\['push'\\]"),
        ({"push": PUSH[:2]}, 6, "got 2 equilibria"),
        ({"push": PUSH}, 2, "2 modes, need 4 equilibria and 3"),
    ],
)
def test_what_cannot_train_is_refused(path: Any, modes, text):
    with pytest.raises(ValueError, match=text):
        systems.sampled_body(beam(), [path], modes=modes)


def test_a_body_with_moved_supports_is_refused():
    body = beam()
    moved = fem.Prescribed(body.problem.supports[0].nodes, [0.0, 0.0], name="clamp")
    problem = dataclasses.replace(body.problem, supports=(moved,))
    body = systems.FemBody(problem, driven=("push", "clamp"))
    with pytest.raises(ValueError, match="driven supports"):
        systems.sampled_body(body, [{"push": PUSH}], modes=6)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"kinematics": fem.PlaneStress(0.01)}, "sheet in plane stress"),
        ({"relaxation": material.Prony([0.4], [jnp.linspace(0.1, 0.2, 32)])}, "times per cell"),
    ],
)
def test_relaxation_that_coordinates_cannot_have_is_refused(options, text):
    body = beam(**{"relaxation": RELAXING, **options})
    with pytest.raises(ValueError, match=text):
        systems.sampled_body(body, [{"push": PUSH}], modes=6)


def test_two_paths_of_odd_length_each_train_on_every_second_state():
    """The states that tell the error are those between, of each path by itself."""
    paths = [{"push": PUSH}, {"push": -PUSH[:5]}]
    body = beam()
    seen, told, slopes = _equilibria(body, paths, body.problem)
    assert (len(seen), len(told), len(slopes)) == (8, 6, 16)
    want = np.concatenate([PUSH[1::2], -PUSH[1:5:2]])
    np.testing.assert_allclose(np.stack([s.inputs["push"] for s in told]), want)


def test_an_equilibrium_that_is_not_found_is_an_infinite_error():
    body = trained().body
    lost = eqx.tree_at(lambda b: b.force.volumes, body, jnp.nan * body.force.volumes)  # pyright: ignore
    whole = beam()
    _, told, _ = _equilibria(whole, [{"push": PUSH[:2]}], whole.problem)
    assert float(_error(whole, lost, told)) == np.inf


@pytest.mark.parametrize("small", [trained, relaxing])
def test_a_stored_one_is_the_same_body(small, tmp_path):
    """Read from a file alone, with no tree of its structure beside."""
    file = tmp_path / "small.npz"
    io.save(file, small())
    again = io.load(file)
    assert repr(again) == repr(small())
    push = systems.Source(systems.Constant([0.0, -0.1]), unit="N")
    films = [
        systems.simulate(
            systems.Network({"body": each.body, "push": push}, {"body.push": "push.value"}),
            0.01, save=3, step=1e-3, solver=systems.Rosenbrock2(refresh=True),
        )
        for each in (small(), again)
    ]  # fmt: skip
    np.testing.assert_array_equal(films[1]["body.q"], films[0]["body.q"])
    assert np.any(np.asarray(films[0]["body.q"][-1]) != 0)
