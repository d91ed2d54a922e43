"""Files with a few bytes changed, and constructors given any number: refused by name, or right.

Examples are drawn by hypothesis, the same in every run.
"""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from sorojax import io, material, mesh, rod as R, sdf
from sorojax.math.lie import SE2

TETRAHEDRON = sdf.Surface(
    np.array([[0.0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]]),
    np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]),
)
GRID = mesh.rectangle([0, 0], [1, 1], divisions=(2, 1))
TREE = {"a": np.arange(3.0), "b": {"c": np.array([1, 2])}}

drawn = settings(max_examples=120, deadline=None, derandomize=True)
#: Where in the file, and what becomes of it there.
edits = st.lists(
    st.tuples(
        st.floats(0, 1, exclude_max=True),
        st.one_of(
            st.binary(max_size=4),
            st.sampled_from([b"nan", b"-1", b"1e999", b"99999999999", b"\n", b" ", b"cut"]),
        ),
        st.integers(0, 4),
    ),
    min_size=1,
    max_size=3,
)


def damaged(data: bytes, changes) -> bytes:
    """`data` with some bytes at each place exchanged, or nothing after it."""
    for share, new, old in changes:
        at = int(share * len(data))
        data = data[:at] if new == b"cut" else data[:at] + new + data[at + old :]
    return data


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("damaged")


@pytest.mark.stress(33)
@pytest.mark.parametrize(
    "name, text",
    [("a.stl", False), ("a.stl", True), ("a.obj", False), ("a.ply", False), ("a.ply", True)],
)
def test_a_damaged_surface_is_refused_or_a_surface(folder, name, text):
    io.export_surface(folder / name, TETRAHEDRON, text=text)
    whole = (folder / name).read_bytes()

    @drawn
    @given(edits)
    def check(changes):
        (folder / name).write_bytes(damaged(whole, changes))
        try:
            found = io.import_surface(folder / name)
        except ValueError as refusal:
            assert str(refusal).startswith("import_surface: "), refusal
            return
        assert np.isfinite(found.vertices).all()
        if len(found.triangles):
            assert found.triangles.min() >= 0 and found.triangles.max() < len(found.vertices)

    check()


@pytest.mark.stress(33)
@pytest.mark.parametrize("name", ["a.vtu", "a.msh", "a.inp"])
def test_a_damaged_mesh_is_refused_or_a_mesh(folder, name):
    io.export_mesh(folder / name, GRID)
    whole = (folder / name).read_bytes()

    @settings(drawn, max_examples=60)
    @given(edits)
    def check(changes):
        (folder / name).write_bytes(damaged(whole, changes))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = io.import_mesh(folder / name)
        except ValueError as refusal:
            assert str(refusal).startswith("import_mesh: "), refusal
            return
        points, cells = np.asarray(found.points), np.asarray(found.cells)
        assert np.isfinite(points).all() and (cells >= 0).all() and (cells < len(points)).all()

    check()


@pytest.mark.stress(33)
def test_a_damaged_state_is_refused_or_of_the_structure_asked_for(folder):
    io.save(folder / "a.npz", TREE)
    whole = (folder / "a.npz").read_bytes()

    @drawn
    @given(edits)
    def check(changes):
        (folder / "a.npz").write_bytes(damaged(whole, changes))
        try:
            found = io.load(folder / "a.npz", TREE)
        except ValueError as refusal:
            assert str(refusal).startswith("io.load: "), refusal
            return
        assert jax.tree.structure(found) == jax.tree.structure(TREE)
        assert found["a"].shape == (3,) and found["b"]["c"].shape == (2,)

    check()


number = st.one_of(
    st.sampled_from([0.0, -1.0, -1e-9, 0.5, np.nan, np.inf, -np.inf]),
    st.floats(1e-4, 1e4),
    st.floats(-1e4, -1e-4),
)
pair = st.tuples(number, number)


def _ball(x, y, r):
    shape = sdf.Circle((x, y), r)
    return (r, *shape.center), r > 0


def _box(x, y, r):
    lower, upper = (x, y), (x + r, y + r)
    sdf.Rectangle(lower, upper)
    return (*lower, *upper), r > 0


def _rubber(x, y, r):
    rubber = material.neo_hookean(young_modulus=x, poisson_ratio=y, density=1000.0)
    return (rubber.shear_modulus, rubber.bulk_modulus), x > 0 and -1 < y < 0.5


def _rod(x, y, r):
    body = R.rod(
        SE2(), R.constant("kappa_z"), R.circle(r), length=x, young_modulus=1e6,
        poisson_ratio=y, density=1000.0,
    )  # fmt: skip
    return (body.length,), x > 0 and r > 0


def _grid(x, y, r):
    cells = mesh.rectangle((x, y), (x + r, y + r), divisions=(1, 1))
    return tuple(np.asarray(cells.points).ravel()), r > 0


@pytest.mark.stress(16)
@pytest.mark.parametrize("make", [_ball, _box, _rubber, _rod, _grid])
def test_a_constructor_takes_what_can_be_and_names_what_cannot(make):
    @settings(drawn, max_examples=60)
    @given(number, number, number)
    def check(x, y, r):
        try:
            numbers, possible = make(x, y, r)
        except ValueError as refusal:
            assert "need" in str(refusal) or "must" in str(refusal), refusal
            return
        assert possible, (x, y, r)
        assert np.isfinite(jnp.asarray(numbers)).all(), (x, y, r)

    check()
