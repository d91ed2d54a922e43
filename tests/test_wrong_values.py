"""Verbs that a user starts with, given valid arguments with one of them spoiled: a result, or
an error of the framework; never one of JAX, NumPy or a missing attribute."""

import copy
import inspect
import linecache
import pickle
import traceback

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sorojax as sj
from sorojax import Status, design, fem, material, mesh, rod, sdf, systems, view
from sorojax.mesh.enrich import with_centres
from sorojax.rod.statics.equilibrium import Solution

RUBBER = material.neo_hookean(young_modulus=1e5, poisson_ratio=0.4, density=1e3)
SQUARE = mesh.rectangle([0, 0], [1, 1], divisions=(1, 1))
LEFT = mesh.nodes_where(SQUARE, lambda p: p[0] <= 0)
RIGHT = mesh.facets_where(SQUARE, lambda p: p[0] >= 1)
HELD, PUSHED = fem.Fixed(LEFT), fem.Traction(RIGHT, [1.0, 0.0], name="push")
PROBLEM = fem.problem(
    SQUARE, RUBBER, kinematics=fem.PlaneStrain(), supports=(HELD,), loads=(PUSHED,)
)
U = jnp.zeros_like(SQUARE.points)
BASIS = rod.constant("kappa_z")
ROD = rod.rod(
    sj.SE2(),
    BASIS,
    rod.circle(0.01),
    length=0.1,
    young_modulus=1e5,
    poisson_ratio=0.4,
    density=1e3,
)
Q = jnp.zeros(1)
DISC = sdf.Circle([0.0, 0.0], 1.0)
NETWORK = systems.Network({"lag": systems.Lag(0.1)}, {}, ("lag.a",))

#: Valid arguments of a verb, by path.
VALID = {
    "fem.problem": {
        "mesh": SQUARE, "material": RUBBER, "kinematics": fem.PlaneStrain(),
        "supports": (HELD,), "loads": (PUSHED,),
    },
    "fem.solve": {"problem": PROBLEM, "start": U, "steps": 1},
    "fem.residual": {"problem": PROBLEM, "u": U},
    "fem.enclosed_volume": {"problem": PROBLEM, "u": U, "facets": RIGHT},
    "fem.reaction_force": {"problem": PROBLEM, "u": U, "nodes": LEFT},
    "fem.reactions": {"problem": PROBLEM, "u": U, "about": np.zeros(2)},
    "fem.with_load": {"problem": PROBLEM, "name": "push", "value": np.ones(2)},
    "fem.nodal_average": {"problem": PROBLEM, "field": np.ones((2, 3))},
    "fem.eigenmodes": {"problem": PROBLEM, "displacement": U, "count": 1},
    "fem.Fixed": {"nodes": LEFT, "components": (0,)},
    "fem.Prescribed": {"nodes": LEFT, "displacement": np.zeros(2), "name": "grip"},
    "fem.Pressure": {"facets": RIGHT, "value": 1.0, "name": "air"},
    "fem.Force": {"nodes": LEFT, "value": np.zeros(2)},
    "fem.Gravity": {"value": np.zeros(2)},
    "rod.rod": {
        "group": sj.SE2(), "basis": BASIS, "section": rod.circle(0.01), "length": 0.1,
        "young_modulus": 1e5, "poisson_ratio": 0.4, "density": 1e3,
    },
    "rod.equilibrium": {"model": ROD, "forces": (rod.Gravity(),), "q": Q},
    "rod.rollout": {"model": ROD, "q": Q, "v": Q, "forces": (), "step": 1e-3, "saves": 2},
    "rod.forward_kinematics": {"model": ROD, "q": Q, "s": np.ones(1)},
    "rod.mass_matrix": {"model": ROD, "q": Q},
    "rod.forward_dynamics": {"model": ROD, "q": Q, "v": Q, "forces": ()},
    "rod.tip_pose": {"model": ROD, "q": Q},
    "rod.motion": {"model": ROD, "q": Q, "v": Q},
    "rod.inverse_kinematics": {"model": ROD, "targets": rod.Position([0.1, 0.01]), "q": Q},
    "rod.Position": {"position": np.zeros(2), "s": 1.0},
    "rod.TipWrench": {"wrench": np.zeros(3)},
    "rod.Tendons": {"routes": (rod.Straight([0.005]),), "tension": np.ones(1)},
    "rod.circle": {"radius": 0.01},
    "rod.chebyshev": {"kappa_z": 2},
    "rod.constant": {},
    "systems.Lag": {"time": 0.1},
    "systems.Regulator": {"proportional": 1e-8, "integral_gain": 1e-7},
    "systems.Reservoir": {"start_pressure": 0.0, "dead_volume": 1e-5},
    "systems.Network": {
        "blocks": {"lag": systems.Lag(0.1)}, "wires": {}, "exposed": ("lag.a",),
    },
    "systems.simulate": {
        "network": NETWORK, "duration": 0.1, "inputs": {"lag.a": 1.0}, "save": 2,
    },
    "mesh.triangulate": {"shape": DISC, "size": 1.0},
    "mesh.facets_on": {"mesh": SQUARE, "shape": DISC, "tol": 1e-6},
    "mesh.nodes_where": {"mesh": SQUARE, "predicate": lambda p: p[0] > 0},
    "mesh.nodes_in_box": {"mesh": SQUARE, "lower": np.zeros(2), "upper": np.ones(2)},
    "mesh.nearest_node": {"mesh": SQUARE, "point": np.zeros(2)},
    "mesh.locate": {"mesh": SQUARE, "points": np.full((1, 2), 0.3)},
    "mesh.rectangle": {"lower": np.zeros(2), "upper": np.ones(2), "divisions": (1, 1)},
    "mesh.named": {"mesh": SQUARE, "name": "boundary"},
    "mesh.enclosed_volume": {"mesh": SQUARE, "facets": RIGHT},
    "mesh.Mesh": {
        "points": SQUARE.points, "cells": SQUARE.cells, "element": SQUARE.element,
    },
    "sdf.Circle": {"center": np.zeros(2), "radius": 1.0},
    "sdf.Box": {"lower": np.zeros(3), "upper": np.ones(3)},
    "sdf.Polygon": {"vertices": np.array([[0.0, 0], [1, 0], [0, 1]])},
    "sdf.translate": {"shape": DISC, "offset": np.zeros(2)},
    "sdf.rotate": {"shape": DISC, "angle": 0.1},
    "sdf.offset": {"shape": DISC, "thickness": 0.1},
    "sdf.evaluate": {"shape": DISC, "points": np.zeros((1, 2))},
    "material.neo_hookean": {"young_modulus": 1e5, "poisson_ratio": 0.4},
    "material.Yeoh": {"c1": 1e5, "c2": 0.0, "c3": 0.0, "bulk_modulus": 1e7},
    "material.fit_tensile": {"strain": np.linspace(0.1, 1, 5), "stress": np.linspace(1, 9, 5)},
    "design.cone_filter": {"mesh": SQUARE, "radius": 0.5},
    "design.layout": {"mesh": SQUARE, "radius": 0.5, "solid": np.zeros(1, int)},
    "design.Mirrored": {"axis": 0, "at": 0.5},
}  # fmt: skip

WRONG = {
    "None": None, "name": "air", "int": 7, "negative": -1, "float": 2.5, "nan": np.nan,
    "complex": 1j, "function": len, "object": object(), "class": fem.Fixed, "module": np,
    "mesh": SQUARE, "problem": PROBLEM, "rod": ROD, "force": rod.Gravity(), "load": PUSHED,
    "empty": (), "tuple of None": (None,), "ragged": [[1.0], [1.0, 2.0]], "dict": {"a": 1.0},
    "bytes": b"air", "text": np.array(["a"]),
}  # fmt: skip


def spoiled(value):
    """`value` in another shape, precision or kind of number."""
    if not isinstance(value, jax.Array | np.ndarray):
        return
    array = np.asarray(value)
    yield "another axis", array[None]
    yield "one longer", np.concatenate([array, array[:1]])
    yield "none", array[:0]
    yield "complex", array * 1j
    yield "single", array.astype(np.float32)
    yield "list", array.tolist()
    if array.dtype.kind == "f":
        yield "nan", np.full_like(array, np.nan)
        yield "whole", array.astype(int)
    else:
        yield "far", array + 1000
        yield "floating", array + 0.5


def is_spoken(error):
    """Whether the framework itself raised the error."""
    frame, line = list(traceback.walk_tb(error.__traceback__))[-1]
    code = linecache.getline(frame.f_code.co_filename, line).strip()
    return frame.f_globals["__name__"].startswith("sorojax.") and code.startswith("raise ")


def verb(path):
    floor, name = path.split(".")
    return getattr(getattr(sj, floor), name)


def test_what_is_valid_is_taken():
    for path, arguments in VALID.items():
        verb(path).__arguments__.check((), arguments)


@pytest.mark.filterwarnings("ignore:.*set as static")
@pytest.mark.stress(62)
@pytest.mark.parametrize("path", VALID)
def test_one_argument_spoiled_is_a_result_or_an_error_of_the_framework(path):
    raw = []
    for name, value in VALID[path].items():
        for what, wrong in [*WRONG.items(), *spoiled(value)]:
            try:
                verb(path)(**{**VALID[path], name: wrong})
            except Exception as error:
                is_known = isinstance(error, TypeError | ValueError | fem.ConvergenceError)
                if not (is_known and is_spoken(error)):
                    raw.append(f"{path}({name}={what}): {error!r}"[:200])
    assert not raw, "\n".join(raw)


def call(function, *args, **options):
    with pytest.raises((TypeError, ValueError)) as caught:
        function(*args, **options)
    assert is_spoken(caught.value), caught.value
    return str(caught.value)


def test_messages_say_got_need_do():
    for got, need, do in (
        (call(rod.equilibrium, ROD, rod.Gravity()), "need a tuple", "`(forces,)`"),
        (call(fem.solve, SQUARE), "need a Problem", "fem.problem"),
        (call(fem.enclosed_volume, PROBLEM, U, "air"), "facet_nodes", "mesh.named"),
        (call(fem.nodal_average, SQUARE, U), "need a Problem", "fem.problem"),
        (call(fem.problem, SQUARE, material.NeoHookean, supports=()), "Abstract", "Make one"),
        (call(fem.residual, PROBLEM, np.zeros((7, 2))), "need 4 along its axis", "belong"),
        (call(fem.residual, PROBLEM, np.zeros((1, 4, 2))), "(nodes, dim)", "jax.vmap"),
        (call(fem.reaction_force, PROBLEM, U, np.array([9])), "need 0 to 3", "this mesh"),
        (call(rod.stiffness_matrix, ROD, Q), "got 2 arguments", "stiffness_matrix(model)"),
        (call(sdf.Circle, 1.0), "missing", "Circle(center, radius)"),
        (call(design.Mirror, "x", 0.0), "need a whole number", "int"),
        (call(rod.functions, kappa_z=lambda s: 1.0), "shape ()", "np.ones_like(s)"),
        (call(sj.jit, 3.0), "need a function", "lambda"),
        (call(sj.compiled, "air"), "need a function", "lambda"),
        (call(sj.listen, 3), "need a function", "lambda"),
        (call(design.layout, SQUARE, symmetries=(design.Mirror(0, 0.5),)), "AbstractSymmetry",
         "design.Mirrored"),
    ):  # fmt: skip
        assert need in got and do in got, got


def test_traced_sizes_are_named():
    def force(load):
        joined = jnp.concatenate([jnp.asarray(RIGHT[:1]), jnp.asarray(RIGHT[1:])])
        pull = fem.Traction(joined, load * jnp.ones(2))
        made = fem.problem(
            SQUARE, RUBBER, kinematics=fem.PlaneStrain(), supports=(HELD,), loads=(pull,)
        )
        return fem.residual(made, U)

    assert "`loads[0].facets`" in call(jax.jit(force), 1.0)


def test_a_function_of_the_user_raises_its_own_errors():
    def wrong(p):
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        mesh.nodes_where(SQUARE, wrong)
    with pytest.raises(AttributeError, match="nothing"):
        mesh.nodes_where(SQUARE, lambda p: p.nothing)


def test_a_checked_verb_is_the_same_to_pickle_jax_and_a_reader():
    assert pickle.loads(pickle.dumps(fem.solve)) is fem.solve
    assert list(inspect.signature(fem.solve).parameters)[0] == "problem"
    stacked = jax.vmap(rod.tip_pose, (None, 0))(ROD, jnp.zeros((3, 1)))
    assert stacked.shape == (3, 3, 3)
    assert jax.eval_shape(rod.mass_matrix, ROD, Q).shape == (1, 1)


@pytest.mark.stress(63)
def test_a_compiled_program_takes_no_number_that_it_would_cut():
    double = sj.compiled(lambda n, x: n * x, 1, jnp.ones(2))
    small = sj.compiled(lambda n: 2 * n, jnp.int32(1))
    assert np.allclose(double(np.int32(3), np.ones(2, np.float32)), 3.0)
    assert int(small(np.int64(7))) == 14
    for program, args in (
        (double, (2.7, jnp.ones(2))), (double, (2, 1j * np.ones(2))), (double, ("a", 1.0)),
        (double, (2**70, jnp.ones(2))), (small, (2**40,)), (small, (np.int64(2**40),)),
    ):  # fmt: skip
        assert "compiled: got" in call(program, *args)


class Forgetful(systems.AbstractBlock):
    """x' = v, v' = -x, or what is forgotten of it."""

    rates: object = eqx.field(static=True)

    inputs = property(lambda self: {})
    outputs = property(lambda self: {"x": systems.Output(None)})

    def initial_state(self):
        return {"x": jnp.ones(()), "v": jnp.zeros(())}

    def output(self, name, t, state, inputs):
        return state["x"]

    def vector_field(self, t, state, inputs):
        return self.rates(state)


@pytest.mark.stress(64)
@pytest.mark.parametrize("step", [None, 0.1])
@pytest.mark.parametrize(
    ("rates", "words"),
    [
        (lambda s: {"x": s["v"]}, "no rate of the state leaf `['v']`"),
        (lambda s: {"x": s["v"], "v": jnp.ones(2)}, r"shape (2,) for the state leaf `['v']`"),
        (lambda s: {"x": s["v"], "v": -s["x"], "w": s["x"]}, "`['w']` that its state has not"),
    ],
)
def test_a_rate_that_does_not_fit_its_state_is_named(rates, words, step):
    network = systems.Network({"mass": Forgetful(rates)}, {})
    text = call(systems.simulate, network, 1.0, save=2, step=step)
    assert "`mass`" in text and words in text


def test_ports_written_as_methods_and_controllers_without_memory_are_told():
    class Method(Forgetful):
        def inputs(self):
            return {}

    assert "@property" in call(systems.Network, {"b": Method(lambda s: s)}, {})
    options = {"period": 0.01, "measurement": "lag.value", "command": "lag.a"}
    text = call(systems.simulate_sampled, NETWORK, lambda t, y, m: (y, m), 0.1, **options)
    assert "memory=" in text


@pytest.mark.stress(65)
def test_tendons_do_not_push():
    route = rod.Straight([0.005])
    assert "Tendons pull" in call(rod.Tendons, route, -5.0)
    moment = rod.motion(ROD, Q)
    force = jax.jit(lambda pull: rod.Tendons(route, pull)(0.0, moment))
    later = rod.Tendons(route, lambda t: jnp.array([-5.0]))(0.0, moment)
    assert float(force(5.0)[0]) != 0.0 == float(force(-5.0)[0]) == float(later[0])
    way = fem.route(SQUARE, [[0.1, 0.2], [0.9, 0.3]])
    assert "Tendons pull" in call(fem.Tendon, way, -5.0)
    pulled = fem.problem(
        SQUARE,
        RUBBER,
        kinematics=fem.PlaneStrain(),
        supports=(HELD,),
        loads=(fem.Tendon(way, 5.0),),
    )
    pushed = fem.with_load(pulled, "tendon", -5.0)
    assert float(jnp.abs(fem.residual(pulled, U)).max()) > 1.0
    assert float(jnp.abs(fem.residual(pushed, U)).max()) == 0.0
    slope = jax.grad(lambda pull: rod.Tendons(route, pull)(0.0, moment)[0])(0.0)
    assert float(slope) == pytest.approx(float(force(1.0)[0]))  # where paths of loads begin


@pytest.mark.stress(66)
def test_vectors_are_of_the_space_that_they_act_in():
    pushed = fem.problem(
        SQUARE,
        RUBBER,
        kinematics=fem.PlaneStrain(),
        supports=(HELD,),
        loads=(fem.Force([2, 3], [0.0, 1.0], name="push"),),
    )
    weight, tip = rod.Gravity([0.0, 0.0, -9.81]), rod.TipWrench(np.zeros(6))
    rest = jnp.zeros(ROD.basis.num_dof)
    for verb, *given in (
        (sj.replace, pushed, lambda p: p.loads[0].value, [0.0, 1.0, 2.0]),
        (fem.with_load, pushed, "push", [0.0, 1.0, 2.0]),
        (rod.equilibrium, ROD, (weight,)),
        (rod.forward_dynamics, ROD, rest, rest, (tip,)),
    ):
        assert "need" in call(verb, *given)
    lanes = sj.replace(pushed, lambda p: p.loads[0].value, np.ones((3, 2)))
    assert lanes.loads[0].value.shape == (3, 2)  # for jax.vmap


@pytest.mark.stress(66)
def test_an_edit_is_converted_and_checked_as_by_the_constructor():
    wrench = sj.replace(rod.TipWrench(np.zeros(3)), lambda load: load.wrench, (0, 1, 2)).wrench
    assert isinstance(wrench, jax.Array) and wrench.shape == (3,)
    nodes = sj.replace(HELD, lambda support: support.nodes, [2, 3]).nodes
    assert nodes.dtype == jnp.int32
    both = sj.replace(ROD, lambda r: (r.length, r.section.area), (0.2, 1e-4))
    assert (float(both.length), float(both.section.area)) == (0.2, 1e-4)
    for noun, where, value in (
        (ROD, lambda r: r.length, -1.0), (ROD, lambda r: r.length, "a"),
        (ROD, lambda r: r.length, None), (ROD, lambda r: r.section, 1.0),
        (ROD, lambda r: r.section, rod.Gravity()), (ROD, lambda r: r.missing, 1.0),
        (ROD, lambda r: r.section.area, [1.0, 2.0, 3.0]), (ROD, "length", 1.0),
        (HELD, lambda support: support.nodes, [0.5]), (ROD, lambda r: (r.length,), (1.0, 2.0)),
        (rod.Tendons(rod.Straight([0.005]), 1.0), lambda t: t.tension, [-1.0]),
    ):  # fmt: skip
        call(sj.replace, noun, where, value)
    traced = jax.vmap(lambda x: sj.replace(ROD, lambda r: r.length, x).length)(jnp.ones(2))
    assert traced.shape == (2,)


@pytest.fixture(scope="module")
def hollow():
    shape = sdf.Box([-2.0, -2, -2], [2.0, 2, 2]) - sdf.Sphere([0.0, 0, 0], 1.0)
    return mesh.chambers(mesh.tetrahedralise(shape, size=0.8, order=2))


@pytest.mark.stress(67)
def test_facets_of_a_curved_wall_are_found_and_follow_enrich(hollow):
    plain, richer = hollow.mesh, mesh.enrich(hollow.mesh)
    ball = sdf.Sphere([0.0, 0, 0], 1.0)
    for body in (plain, richer):
        facets = mesh.boundary_facets(body)
        radius = np.linalg.norm(np.asarray(body.points)[facets[:, :3]], axis=2)
        inner = (np.abs(radius - 1) < 1e-5).all(axis=1).sum()
        assert len(mesh.facets_on(body, ball)) == inner == len(body.facet_sets["chamber_0"])
    held = fem.Fixed(mesh.nodes_where(richer, lambda p: p[0] <= -2 + 1e-9))
    rubber = material.neo_hookean(young_modulus=1e5, poisson_ratio=0.49)
    loads = [
        fem.problem(richer, rubber, supports=(held,), loads=(fem.Pressure(f, 1e3),)).loads[0]
        for f in (richer.facet_sets["chamber_0"], hollow.largest())
    ]
    assert np.array_equal(loads[0].facets, loads[1].facets)
    assert "belong to no cell" in call(with_centres, richer, [[0, 1, 10, 2, 3, 4]])


def test_a_status_prints_its_name():
    status = Status
    each = jax.vmap(lambda good: status.where(good, status.successful, status.max_steps))
    assert repr(status.successful) == "Status(successful)"
    three = each(jnp.array([True, False, True]))
    assert str(three) == "Status(successful: 2, max_steps: 1)"
    assert (three == status.max_steps).tolist() == [False, True, False]
    inside = []
    jax.jit(lambda good: inside.append(str(each(good))))(jnp.ones(2, bool))
    assert inside == ["Status(traced)"]
    assert copy.deepcopy(status.max_steps) == status.max_steps


def test_a_stable_energy_is_not_called_unstable_by_rounding():
    bulk = {"bulk_modulus": 1e9}
    stable = material.Ogden((7.45e4, 0.5226), (2.306, 10.94), **bulk)
    for limit in (10.0, 30.0):
        assert material.drucker_stability(stable, limit=limit).unlimited
    loose = material.drucker_stability(material.Ogden((7.45e4, -1e3), (2.306, 10.94), **bulk))
    assert loose.uniaxial[1] < 3.0 and not loose.unlimited


def test_surfaces_and_sweeps_print_in_a_few_lines():
    surface = sdf.isosurface(sdf.Sphere([0.0, 0, 0], 1.0), 0.5)
    assert str(surface).startswith("Surface: 78 vertices")
    assert len(str(sdf.surface_report(surface)).splitlines()) == 2


def test_a_picture_without_its_model_is_told():
    zero = jnp.zeros((), int)
    found = Solution(Q, Status.successful, zero, zero)
    assert "'model'" in call(view.show, found)
    assert "colour" in call(view.show, ROD, colour=3)
