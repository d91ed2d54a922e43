"""Results in files, opened without the problem that they belong to."""

import json
import sys
import zipfile

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import fem, io, mesh, view
from sorojax.cli.main import main
from sorojax.fem.equilibrium.solve import Path
from sorojax.io import state as _structure
from sorojax.math.status import Status
from tests.test_pickle import SCENES, beam, iterated, same, tip


@pytest.fixture(scope="module")
def solution():
    return fem.solve(beam())


@pytest.mark.stress(60)
@pytest.mark.parametrize(
    "name", [name for name in SCENES if name not in ("iterated problem", "swept")]
)
def test_what_a_scene_gives_is_opened_without_it(name, tmp_path):
    scene = SCENES[name]()
    io.save(tmp_path / "a.npz", scene)
    back = io.load(tmp_path / "a.npz")
    assert same(back, scene) and type(back) is type(scene)


@pytest.mark.stress(60)
def test_a_solution_that_is_opened_goes_on(solution, tmp_path):
    for number, problem in enumerate((solution.problem, iterated(solution.problem))):
        io.save(tmp_path / f"{number}.npz", problem)
        back = io.load(tmp_path / f"{number}.npz")
        assert np.array_equal(tip(back), tip(problem))
    lanes = jax.vmap(lambda p: fem.solve(fem.with_load(beam(), "traction", p)))(
        jnp.array([[1e3, 0.0], [2e3, 0.0]])
    )
    io.save(tmp_path / "lanes.npz", lanes)
    assert same(io.load(tmp_path / "lanes.npz"), lanes)


@pytest.mark.stress(60)
def test_a_saved_solution_is_shown(solution, tmp_path, capsys):
    file, out = tmp_path / "s.npz", tmp_path / "s.png"
    io.save(file, solution)
    for words in ((), ("--field", "displacement", "--wire")):
        assert main(["show", str(file), "--out", str(out), *words]) == 0
    assert out.read_bytes().startswith(b"\x89PNG") and "wrote" in capsys.readouterr().out
    assert view.show_file(file).png
    io.save(file, {"a": jnp.zeros(3)})
    assert main(["show", str(file), "--out", str(out)]) == 2
    assert "holds a dict of ['a'] (3,), need a noun" in capsys.readouterr().err


def test_plain_data_come_back_as_they_were(tmp_path):
    tree = {
        "numbers": (1, -0.0, 1e300, float("inf"), True, None, "text"),
        "arrays": [np.float32(0.1), np.arange(3)[::2], jnp.zeros((0, 2)), Status.not_finite],
        "key": jax.random.key(7),
        "lanes": jax.vmap(lambda x: Status.where(x, Status.successful, Status.max_steps))(
            jnp.array([True, False])
        ),
    }
    io.save(tmp_path / "a.npz", tree)
    back = io.load(tmp_path / "a.npz")
    assert repr(back["numbers"]) == repr(tree["numbers"]) and back["lanes"]._value.shape == (2,)
    assert isinstance(back["arrays"][0], np.float32) and isinstance(
        back["arrays"][1], np.ndarray
    )
    assert isinstance(back["arrays"][2], jax.Array) and back["arrays"][3] == Status.not_finite
    assert jnp.array_equal(jax.random.key_data(back["key"]), jax.random.key_data(tree["key"]))


class Foreign(eqx.Module):
    x: jax.Array


@pytest.mark.stress(60)
@pytest.mark.parametrize(
    ("tree", "why"),
    [
        ({"f": np.sin, "x": jnp.ones(2)}, r"`\['f'\]` is a numpy.ufunc"),
        ([lambda x: x, jnp.ones(2)], r"`\[0\]` is a function"),
        (Foreign(jnp.ones(2)), "the tree is a .*test_io_state.Foreign"),
        ({"x": jnp.ones(2), "s": {1, 2}}, r"`\['s'\]` is a set"),
    ],
)
def test_what_is_more_than_data_of_sorojax_needs_like(tree, why, tmp_path):
    io.save(tmp_path / "a.npz", tree)
    with pytest.raises(ValueError, match=f"arrays only \\({why}\\), need .* as `like`"):
        io.load(tmp_path / "a.npz")
    assert eqx.tree_equal(io.load(tmp_path / "a.npz", tree), tree)


def test_what_would_be_an_empty_file_is_not_written(tmp_path):
    for nothing in (SCENES["swept"](), np.sin, [{1}]):
        with pytest.raises(
            ValueError, match="io.save: got a .* without arrays .*, need arrays"
        ):
            io.save(tmp_path / "a.npz", nothing)
    assert not list(tmp_path.iterdir())


def rewritten(file, structure):
    """The file with another structure, everything else in order."""
    with np.load(file) as found:
        arrays = dict(found)
    header = json.loads(arrays["sorojax.json"].tobytes()) | {"structure": structure}
    arrays["sorojax.json"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(file, **arrays)


def named(name, **fields):
    return {"class": name, "fields": fields}


CRAFTED = {
    "a module": named("os.system", command="ls"),
    "a class of Python": named("builtins.object"),
    "a function": named("fem.solve.solve", problem=1),
    "a function of JAX": named("fem.solve.jax.jit", fun=1),
    "a module behind": named("fem.solve.eqx.Module"),
    "a borrowed class": named("fem.solve.Problem"),
    "an abstract class": named("fem.AbstractContents"),
    "a room above": named("view.Picture", png=1),
    "an error": named("fem.ConvergenceError", args=[]),
    "no name": named(None),
    "a long name": named("fem." + "x" * 10_000),
    "other fields": named("fem.PlaneStrain", depth=1.0),
    "no fields": {"class": "fem.PlaneStrain"},
    "fields in a list": {"class": "fem.PlaneStrain", "fields": [1]},
    "an outcome": {"outcome": "math.Status", "value": 1},
    "no outcome": {"outcome": "fem.Problem", "value": {"array": "['i']", "as": "jax"}},
    "an outcome beyond": {"outcome": "math.Status", "value": {"array": "['i']", "as": "jax"}},
    "an outcome as a class": named("math.Status"),
    "an array that is not there": {"array": "b", "as": "jax"},
    "an array by number": {"array": 3, "as": "jax"},
    "a list for an array": {"array": [1], "as": "jax"},
    "another kind": {"array": "['i']", "as": "object"},
    "no key": {"array": "['i']", "as": "key threefry2x32"},
    "a key of no kind": {"array": "['i']", "as": "key x"},
    "a number with a shape": {"array": "['i']", "as": "number"},
    "a tuple of a number": {"tuple": 3},
    "a dict of numbers": {"dict": 3},
    "a dict with a list for a key": {"dict": [[[1], 2]]},
    "a dict of threes": {"dict": [[1, 2, 3]]},
    "an array twice": {"list": 2 * [{"array": "['i']", "as": "jax"}]},
    "an array that belongs nowhere": 3,
    "a bare list": [1],
    "nothing known": {"reduce": ["os.system", ["ls"]]},
    "a system": named(
        "math.sparse.SparseSymmetric", iterative=None, size=2,
        **{name: {"array": "['i']", "as": "jax"} for name in ("rows", "cols", "slots", "key")},
    ),
    "a system of words": named(
        "math.sparse.SparseSymmetric", iterative=None, size="2", rows="a", cols="b", slots="c",
        key="d",
    ),
}  # fmt: skip


@pytest.mark.stress(60)
def test_a_file_can_name_nothing_but_data_classes_of_sorojax():
    names = {
        f"{module.removeprefix('sorojax.')}.{name}"
        for module, content in list(sys.modules.items())
        if module.startswith("sorojax.")
        for name in vars(content)
    }
    found = {cls for name in names if (cls := _structure._class(name)) is not None}
    assert len(found) > 200 and Status in found
    for cls in found:
        assert cls.__module__.startswith("sorojax.") and not issubclass(cls, BaseException)
        assert issubclass(cls, eqx.Module | eqx.Enumeration) or _structure._fields(cls)
        assert not hasattr(cls, "__del__")


def test_a_class_is_found_by_its_name_in_a_file_wherever_its_module_stands():
    for package in _structure._PACKAGES:
        classes = set(_structure._data_classes(package).values())
        assert classes or package == "contact"
        for cls in classes:
            name = _structure._name(cls, "")
            assert _structure._class(name) is cls and name.startswith(f"{package}."), name
    assert _structure._name(Path, "") == "fem.Path"  # not public, and no other has its name


@pytest.mark.stress(60)
@pytest.mark.parametrize("what", CRAFTED)
def test_a_crafted_structure_is_refused(what, tmp_path):
    file = tmp_path / "a.npz"
    io.save(file, {"i": jnp.array([70, 80])})
    rewritten(file, CRAFTED[what])
    with pytest.raises(ValueError, match="^io.load: .* is damaged .*, need a file of io.save"):
        io.load(file)


def test_a_deep_structure_is_refused(tmp_path):
    file, deep = tmp_path / "a.npz", 1
    io.save(file, {"i": jnp.array([70, 80])})
    for _ in range(100):
        deep = {"tuple": [deep]}
    io.save(file, ())
    rewritten(file, deep)
    assert isinstance(io.load(file), tuple)
    text = b'{"format": 1, "leaves": {}, "structure": ' + 5000 * b'{"tuple": [' + b"1"
    np.savez(file, **{"sorojax.json": np.frombuffer(text + 5000 * b"]}" + b"}", np.uint8)})
    with pytest.raises(ValueError, match="io.load: .* is damaged"):
        io.load(file)


@pytest.mark.stress(60)
@pytest.mark.parametrize(
    "spoil",
    [
        lambda rows, cols: (rows, cols.at[0].set(10**6)),
        lambda rows, cols: (rows, cols.at[0].set(-1)),
        lambda rows, cols: (rows[::-1], cols[::-1]),
        lambda rows, cols: (rows[1:], cols[1:]),
        lambda rows, cols: (rows, cols[1:]),
    ],
)
def test_a_pattern_that_native_code_would_trust_is_checked(solution, spoil, tmp_path):
    system = solution.problem.space.system
    rows, cols = spoil(system.rows, system.cols)
    wrong = eqx.tree_at(lambda s: (s.rows, s.cols), system, (rows, cols))
    io.save(tmp_path / "a.npz", wrong)
    with pytest.raises(ValueError, match="io.load: .* is damaged .*(upper triangle|columns)"):
        io.load(tmp_path / "a.npz")


def test_a_file_of_before_needs_like(tmp_path):
    file = tmp_path / "a.npz"
    io.save(file, mesh.rectangle([0, 0], [1, 1], divisions=(1, 1)))
    with zipfile.ZipFile(file) as archive, archive.open("sorojax.json.npy") as text:
        header = json.loads(np.load(text).tobytes())
    with np.load(file) as found:
        arrays = {name: found[name] for name in found.files if name.startswith("leaf")}
    old = {"format": 1, "leaves": header["leaves"]}
    np.savez(
        file, **{"sorojax.json": np.frombuffer(json.dumps(old).encode(), np.uint8), **arrays}
    )
    with pytest.raises(ValueError, match="an early version wrote it"):
        io.load(file)
    like = mesh.rectangle([0, 0], [2, 2], divisions=(1, 1))
    assert np.max(io.load(file, like).points) == 1


def test_single_precision_does_not_take_double(tmp_path):
    io.save(tmp_path / "a.npz", {"a": jnp.ones(2)})
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(
            ValueError, match="^io.load: `.*` is float64, need double precision"
        ):
            io.load(tmp_path / "a.npz")
    finally:
        jax.config.update("jax_enable_x64", True)
