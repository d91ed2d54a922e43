"""Drawings optimised: meshes that follow and are built anew, modes and loops by shape."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from sorojax import design, fem, io, material, mesh, sdf, systems as S
from sorojax._progress import silent
from sorojax._types import real
from sorojax.fem.problem import load_force
from sorojax.math.status import Status

STUFF = material.neo_hookean(young_modulus=1.0, poisson_ratio=0.3, density=1.0)


def plate(p):
    """Quarter of a square plate with an elliptical hole."""
    hole = sdf.stretch(sdf.Circle([0.0, 0.0], 1.0), jnp.stack([p["a"], p["b"]]))
    return sdf.Rectangle([0.0, 0.0], [1.0, 1.0]) - hole


def mapped(shape):
    """Quadrilaterals from the hole to the outer sides: every such mesh has the same sizes, so
    that a new one compiles nothing."""
    a, b = (float(sdf.bounding_box(shape.removed)[1][i]) for i in (0, 1))
    turn = np.linspace(0, np.pi / 2, 9)
    hole = np.stack([a * np.cos(turn), b * np.sin(turn)], axis=1)
    along = np.linspace(0, 2, 9)[:, None]
    outer = np.clip(np.concatenate([2 - along, along], axis=1), 0, 1)
    share = np.linspace(0, 1, 5)[:, None, None]
    points = ((1 - share) * hole[None] + share * outer[None]).reshape(-1, 2)
    first = (9 * np.arange(4)[:, None] + np.arange(8)[None]).ravel()
    cells = np.stack([first, first + 9, first + 10, first + 1], axis=1)
    return mesh.Mesh(
        points,
        cells,
        mesh.Quad4(),
        {"corners": np.array([0, 8, 36, 40, 44])},
        {"boundary": mesh.boundary_facets(mesh.Mesh(points, cells, mesh.Quad4()))},
    )


def pulled(cells):
    """The plate under equal tractions on its two outer sides."""
    feet = [mesh.nodes_where(cells, lambda p, i=i: p[i] < 1e-9) for i in (0, 1)]
    sides = [mesh.facets_where(cells, lambda p, i=i: p[i] > 1 - 1e-9) for i in (0, 1)]
    return fem.problem(
        cells,
        STUFF,
        kinematics=fem.PlaneStress(1.0),
        formulation=fem.Displacement(),
        supports=tuple(fem.Fixed(n, components=(i,)) for i, n in enumerate(feet)),
        loads=(
            fem.Traction(sides[0], [1e-4, 0.0], name="right"),
            fem.Traction(sides[1], [0.0, 1e-4], name="top"),
        ),
    )


RIGHT, TOP = np.arange(36, 41), np.arange(40, 45)  # nodes of the outer sides
WEIGHTS = jnp.array([0.125, 0.25, 0.25, 0.25, 0.125])


def yielding(problem, _):
    """Work of the tractions, about 1.4 for a plate without hole."""
    u = fem.solve(problem).displacement
    return 1e4 * (WEIGHTS @ u[RIGHT, 0] + WEIGHTS @ u[TOP, 1])


def opening(_, p):
    return 1 - p["a"] * p["b"] / 0.09


START = {"a": jnp.asarray(0.42), "b": jnp.asarray(0.25)}
LOOP = dict(
    mesher=mapped,
    constraints=(opening,),
    optimiser=design.MMA(0.15, 0.6, move=0.1),
    tolerance=2e-3,
)


@pytest.fixture(scope="module")
def whole():
    seen = []
    with silent():
        found = design.minimise_shape(
            yielding, START, plate, pulled, steps=14, on_step=seen.append, **LOOP
        )
    return found, seen


def test_a_hole_under_equal_tension_becomes_round(whole):
    found, seen = whole
    assert found.design["a"] == pytest.approx(0.3, abs=6e-3)
    assert found.design["b"] == pytest.approx(0.3, abs=6e-3)
    assert found.status == Status.successful
    assert abs(float(found.optimised.constraints[0])) < 1e-3
    assert found.num_meshes == 1 + len(found.remeshed) >= 2
    assert seen[-1].num_meshes == found.num_meshes
    # nodes lie on the new hole, whatever mesh they belong to
    points, facets = found.problem.mesh.points, mesh.boundary_facets(found.problem.mesh)
    assert np.abs(plate(found.design)(points[np.unique(facets)])).max() < 1e-9


def test_stopped_in_the_middle_and_read_from_a_file_it_goes_on_alike(whole, tmp_path):
    found, seen = whole
    half = seen[len(seen) // 2]
    io.save(tmp_path / "step.npz", half)
    half = io.load(tmp_path / "step.npz", half)
    with silent():
        rest = design.minimise_shape(
            yielding,
            START,
            plate,
            pulled,
            steps=14,
            resume=half,
            scale=float(found.history["objective"][0]),
            **LOOP,
        )
    assert rest.num_meshes == found.num_meshes
    for name in ("a", "b"):
        assert rest.design[name] == found.design[name]


def test_any_optax_optimiser_drives_a_drawing():
    """To a wanted yielding by one dimension."""
    with silent():
        found = design.minimise_shape(
            lambda problem, p: (yielding(problem, p) - 2.4) ** 2,
            {"a": jnp.asarray(0.35)},
            lambda p: plate({"a": p["a"], "b": p["a"]}),
            pulled,
            mesher=mapped,
            optimiser=optax.sgd(0.01),
            steps=25,
            tolerance=1e-5,
        )
    assert found.status == Status.successful and float(found.objective) < 1e-7


@pytest.mark.slow
def test_unstructured_meshes_are_built_anew_on_the_way(whole):
    with silent():
        found = design.minimise_shape(
            yielding_by_energy,
            START,
            plate,
            pulled,
            size=0.25,
            order=1,
            steps=14,
            **{name: value for name, value in LOOP.items() if name != "mesher"},
        )
    assert found.num_meshes > 1
    assert found.design["a"] == pytest.approx(0.3, abs=6e-3)
    assert float(found.objective) == pytest.approx(float(whole[0].objective), rel=0.02)


def yielding_by_energy(problem, _):
    u = fem.solve(problem).displacement
    return -2e8 * fem.potential_energy(problem, u)


def test_wrong_calls_are_refused():
    with pytest.raises(ValueError, match="`size` or `mesher`"):
        design.minimise_shape(yielding, START, plate, pulled)
    with pytest.raises(ValueError, match="inside jit or vmap"):
        jax.jit(lambda p: fem.eigenmodes(moved(p, 5e-2)).eigenvalues)(DIMENSIONS)


DIMENSIONS = jnp.array([0.42, 0.25])
BODY = pulled(mapped(plate(START)))


def moved(p, traction):
    """The plate with nodes moved to its dimensions, pulled to the right by some percent."""
    points = mesh.move(BODY.mesh, plate({"a": p[0], "b": p[1]})).points
    problem = eqx.tree_at(lambda q: q.mesh.points, BODY, points)
    return fem.with_load(problem, "right", jnp.array([traction, 0.0]))


def modes_of(problem):
    """Two modes about its equilibrium."""
    u = fem.solve(problem, newton=fem.Newton(residual_tolerance=1e-12)).displacement
    return fem.eigenmodes(problem, u, count=2)


def basis(p):
    """Frequencies and shapes at a corner of two modes about the stretched plate."""
    modes = modes_of(moved(p, 5e-2))
    return jnp.concatenate([modes.frequencies, modes.shapes[:, RIGHT[0], 0]])


def central(function, p, step=1e-5):
    ends = [
        [np.asarray(function(p + s * step * way)) for s in (2, 1, -1, -2)]
        for way in np.eye(len(p))
    ]
    return np.stack([(8 * (b - c) - (a - d)) / (12 * step) for a, b, c, d in ends], axis=-1)


def test_a_modal_basis_moves_with_its_drawing():
    found, pull = jax.vjp(basis, DIMENSIONS)
    slopes = np.stack([pull(row)[0] for row in jnp.eye(len(found))])
    want = central(basis, DIMENSIONS)
    assert np.abs(want).min() > 1e-4
    assert np.allclose(slopes, want, rtol=1e-6)


class Modal(S.AbstractBlock):
    """A body in modal coordinates: traction in, displacement of its end out."""

    stiffness: jax.Array = eqx.field(converter=real)
    push: jax.Array = eqx.field(converter=real)
    tip: jax.Array = eqx.field(converter=real)

    @property
    def inputs(self):
        return {"pressure": S.Input("Pa")}

    @property
    def outputs(self):
        return {"tip": S.Output("m")}

    def initial_state(self):
        return {"q": jnp.zeros_like(self.push), "v": jnp.zeros_like(self.push)}

    def output(self, name, t, state, inputs):
        return self.tip @ state["q"]

    def vector_field(self, t, state, inputs):
        damping = 0.4 * jnp.sqrt(self.stiffness)
        force = self.push * inputs["pressure"] - self.stiffness * state["q"]
        return {"q": state["v"], "v": force - damping * state["v"]}


def tracking(p):
    """Squared error of the end under a PID that drives the traction."""
    problem = moved(p, 0.0)
    modes, rest = modes_of(problem), jnp.zeros_like(problem.mesh.points)
    force = load_force(moved(p, 1.0), rest) - load_force(problem, rest)
    push = fem.modal_force(modes, force)
    return _run(Modal(modes.eigenvalues, push, modes.shapes[:, RIGHT[0], 0]))


@eqx.filter_jit
def _run(body):
    pid = S.PID(
        0.3,
        0.3,
        start_measurement=0.0,
        filter_time=0.5,
        measurement_unit="m",
        reference=S.Constant(1.0),
    )
    loop = S.Network(
        {"body": body, "pid": pid},
        {"pid.measurement": "body.tip", "body.pressure": "pid.command"},
    )
    film = S.simulate(loop, 12.0, step=0.1, save=121)
    return jnp.mean((film["body.tip"] - 1.0) ** 2)


def test_a_closed_loop_moves_with_the_drawing_of_its_body():
    value, slopes = jax.value_and_grad(tracking)(DIMENSIONS)
    want = central(tracking, DIMENSIONS)
    assert 0.01 < float(value) < 1.5 and np.abs(want).min() > 1e-3
    assert np.allclose(slopes, want, rtol=1e-6)
