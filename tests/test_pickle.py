"""Nouns, results and errors through pickle and deepcopy, as a pool of processes needs them."""

import copy
import dataclasses
import importlib
import inspect
import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sorojax as sj
from sorojax import fem, material, mesh, rod, sdf, systems
from sorojax._cache import enable_compilation_cache
from sorojax.fem.dynamics.simulate import MotionError
from sorojax.io import state
from sorojax.math.status import Status
from sorojax.sweep.sweep import Swept

WAYS = {"pickle": lambda x: pickle.loads(pickle.dumps(x)), "deepcopy": copy.deepcopy}
FLOORS = sorted(sj._FLOORS)


def public_classes():
    """Every class that holds data and is public or, as results are, written to files."""
    for package in state._PACKAGES:
        for name, cls in state._data_classes(package).items():
            if name.count(".") == 1 and not cls.__name__.startswith("_") and fields(cls):
                yield name, cls
    for floor in FLOORS:
        package = importlib.import_module(f"sorojax.{floor}")
        for name, cls in sorted(vars(package).items()):
            own = inspect.isclass(cls) and cls.__module__.startswith(f"sorojax.{floor}")
            if own and not name.startswith("_") and not inspect.isabstract(cls) and fields(cls):
                yield f"{floor}.{name}", cls


def fields(cls):
    if issubclass(cls, tuple) and hasattr(cls, "_fields"):
        return cls._fields
    return [f.name for f in dataclasses.fields(cls)] if dataclasses.is_dataclass(cls) else []


def blank(cls):
    """An instance whose fields hold one small array each, whatever belongs there."""
    values = {name: jnp.arange(2.0) + k for k, name in enumerate(fields(cls))}
    if issubclass(cls, tuple):
        return tuple.__new__(cls, values.values())
    made = object.__new__(cls)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


PUBLIC = dict(public_classes())


@pytest.mark.versions
@pytest.mark.stress(59)
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", PUBLIC)
def test_instances_of_every_public_class_survive(name, way):
    cls = PUBLIC[name]
    before = blank(cls)
    after = WAYS[way](before)
    assert type(after) is cls and after is not before
    for field in fields(cls):
        assert np.array_equal(getattr(after, field), getattr(before, field)), field


@pytest.mark.versions
def test_the_list_of_public_classes_is_not_short():
    assert (
        len(PUBLIC) > 250 and {"fem.Solution", "rod.Rod", "systems.Trajectory"} <= PUBLIC.keys()
    )


def beam(pull=1e3):
    cells = mesh.rectangle([0, 0], [2, 1], divisions=(2, 1))
    rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.4, density=1e3)
    return fem.problem(
        cells,
        rubber,
        kinematics=fem.PlaneStrain(1.0),
        supports=(fem.Fixed(cells.node_sets["left"]),),
        loads=(fem.Traction(cells.facet_sets["right"], (pull, 0.0)),),
    )


def tip(problem):
    return np.asarray(fem.solve(problem).displacement)


def iterated(problem):
    space = fem.space(problem.mesh, problem.loads, "conjugate_gradient")
    return eqx.tree_at(lambda p: p.space, problem, space)


def planar_rod():
    return rod.rod(
        sj.SE2(),
        rod.chebyshev(kappa_z=2),
        rod.circle(5e-3),
        length=0.1,
        young_modulus=1e5,
        poisson_ratio=0.5,
        density=1e3,
    )


def body():
    lens = sdf.translate(sdf.Circle([0, 0], 1.0), [0.2, 0.1]) & sdf.Circle([0.3, 0], 1.0)
    return sdf.extrude(sdf.rotate(lens - sdf.Rectangle([0, 0], [0.1, 0.1]), 0.3), 0.5)


def run():
    network = systems.Network({"lag": systems.Lag(0.1, 1.0)}, {"lag.a": "lag.value"})
    return systems.simulate(network, 0.1, step=0.05)


def swept():
    return Swept({"y": np.arange(3.0)}, ("a",), 1, 0, "0")


def fitted():
    strain = np.linspace(0.05, 2, 8)
    stress = 1e5 * (1 + strain - (1 + strain) ** -2)
    return material.fit_tensile(strain, stress, model=material.NeoHookean)


SCENES = {
    "problem": beam,
    "iterated problem": lambda: iterated(beam()),
    "solution": lambda: fem.solve(beam()),
    "path": lambda: fem.solve_path(beam(), traction=jnp.array([[5e2, 0], [1e3, 0]])),
    "rod": planar_rod,
    "shape": body,
    "surface": lambda: sdf.isosurface(sdf.Sphere([0, 0, 0], 1e-2), size=5e-3),
    "report": lambda: sdf.surface_report(
        sdf.isosurface(sdf.Sphere([0, 0, 0], 1e-2), size=5e-3)
    ),
    "quality": lambda: mesh.quality(beam().mesh),
    "trajectory": run,
    "swept": swept,
    "fit": fitted,
    "status": lambda: Status.max_steps,
}


def same(a, b):
    """Equal types, structures, and arrays to the bit."""
    if dataclasses.is_dataclass(a) and not isinstance(a, eqx.Module):
        return type(a) is type(b) and all(
            same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a)
        )
    leaves, others = jax.tree.leaves(a), jax.tree.leaves(b)
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        np.array_equal(x, y, equal_nan=np.asarray(x).dtype.kind == "f")
        for x, y in zip(leaves, others, strict=True)
    )


@pytest.fixture(scope="module", params=SCENES)
def scene(request):
    return SCENES[request.param]()


@pytest.mark.stress(59)
@pytest.mark.parametrize("way", WAYS)
def test_what_a_scene_gives_survives(scene, way):
    after = WAYS[way](scene)
    assert same(after, scene) and repr(after)


@pytest.mark.stress(59)
@pytest.mark.parametrize("prepare", [lambda p: p, iterated], ids=["direct", "iterated"])
def test_a_problem_from_a_file_has_the_same_answer_when_its_own_is_gone(prepare):
    problem = prepare(beam())
    want, data = tip(problem), pickle.dumps(problem)
    del problem
    back = pickle.loads(data)
    assert np.array_equal(tip(back), want)
    assert back.space.system.solver is back.space.system._kept.solver


@pytest.mark.stress(59)
def test_a_pool_of_processes_solves_what_it_is_sent():
    problem = beam()
    with ProcessPoolExecutor(1, get_context("spawn"), _start) as pool:
        found = pool.submit(_solved, problem).result(200)
        with pytest.raises(fem.ConvergenceError, match="converge|load") as caught:
            pool.submit(_solved, problem, max_iterations=1).result(200)
    assert np.allclose(found.displacement, tip(problem), rtol=1e-12, atol=1e-15)
    assert caught.value.solution.displacement.shape == (6, 2)


def _start():
    _precision(True)
    enable_compilation_cache()


def _precision(double):
    jax.config.update("jax_enable_x64", double)


@pytest.mark.stress(59)
def test_a_process_of_single_precision_does_not_take_a_problem_of_double():
    data = pickle.dumps(beam())
    _precision(False)
    try:
        with pytest.raises(ValueError, match="single precision, need double .*JAX_ENABLE_X64"):
            pickle.loads(data)
    finally:
        _precision(True)


def _solved(problem, **options):
    return fem.solve(problem, newton=fem.Newton(**options), max_cuts=0)


@pytest.mark.stress(59)
@pytest.mark.parametrize("way", WAYS)
def test_errors_keep_what_they_hold(way):
    for error in (fem.ConvergenceError("no", body()), MotionError("no", planar_rod())):  # type: ignore[arg-type]
        (name,) = vars(error)
        after = WAYS[way](error)
        assert str(after) == "no" and type(after) is type(error)
        assert same(getattr(after, name), getattr(error, name))
