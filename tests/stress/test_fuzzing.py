"""Files with a few bytes changed, and constructors given any number: refused by name, or right.

Examples are drawn by hypothesis, the same in every run.
"""

import json
import warnings
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from sorojax import io, material, mesh, rod as R, sdf
from sorojax.math.lie import SE2
from sorojax.sweep.sweep import Store, digest

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


@pytest.mark.stress(58)
@pytest.mark.parametrize("change", [0xFF, 0x01, 0x08])
def test_a_changed_byte_of_a_sweep_or_a_state_is_noticed_wherever_it_is(tmp_path, change):
    store = Store(tmp_path)
    store.write("key", {"y": np.arange(3.0), "n": np.arange(2)})
    want = digest(store.read("key") or {})
    io.save(tmp_path / "a.npz", TREE)

    def load():
        try:
            return jax.tree.leaves(io.load(tmp_path / "a.npz", TREE))
        except ValueError as refusal:
            assert str(refusal).startswith("io.load: "), refusal
            return None

    def same(found):
        return all(map(np.array_equal, found, jax.tree.leaves(TREE)))

    for file, read, right in (
        (store.path("key"), lambda: store.read("key"), lambda found: digest(found) == want),
        (tmp_path / "a.npz", load, same),
    ):
        whole, noticed = file.read_bytes(), 0
        for at in range(len(whole)):
            file.write_bytes(whole[:at] + bytes([whole[at] ^ change]) + whole[at + 1 :])
            found = read()
            noticed += found is None
            assert found is None or right(found), at
        assert noticed > 0.5 * len(whole)


ENTRY = {"shape": [3], "dtype": "float64", "sha256": ""}
HEADERS = [
    b"", b"[", b"[" * 100_000, b"1" * 5000, b"null", b"[]", b"{}", b"\xff", b'{"leaves": {}}',
    *(
        json.dumps({"format": version, "leaves": leaves}).encode()
        for version, leaves in (
            (None, {}), ("1", {}), (1e400, {}), (True, {}), (1, []), (1, 3), (1, None),
            (1, "a"), (1, {"['a']": None}), (1, {"['a']": []}), (1, {"['a']": {}}),
            (1, {"['a']": ENTRY}),
            (1, {"['a']": ENTRY | {"shape": 3}}), (1, {"['a']": ENTRY | {"shape": ["3"]}}),
            (1, {"['a']": ENTRY | {"dtype": []}}), (1, {f"[{k}]": ENTRY for k in range(9)}),
        )
    ),
]  # fmt: skip


@pytest.mark.stress(58)
@pytest.mark.parametrize("header", HEADERS, ids=lambda header: str(header[:60]))
def test_a_crafted_header_is_refused_by_name(tmp_path, header):
    text = np.frombuffer(header, np.uint8)
    np.savez(tmp_path / "a.npz", **{"sorojax.json": text, "leaf0": np.arange(3.0)})
    for read in (io.leaves, lambda path: io.load(path, {"a": np.zeros(3)})):
        with pytest.raises(ValueError, match="^io\\.(load|leaves): .* is damaged .*, need"):
            read(tmp_path / "a.npz")


@pytest.mark.stress(58)
def test_a_crafted_archive_is_refused_by_name(tmp_path):
    file = tmp_path / "a.npz"
    for damage in (
        lambda: np.savez_compressed(file, a=np.zeros(9)),
        lambda: np.savez(file, **{"sorojax.json": np.array([{}])}),  # an object: pickled
        lambda: file.write_bytes(b"PK\x05\x06" + bytes(18)),
        lambda: _entry(file, "leaf0.npy", b"\x93NUMPY\x01\x00"),
        lambda: _entry(file, "leaf0.npy", _npy("{'descr': '<f8', 'shape': (1" + 15 * "0")),
        lambda: _entry(file, "leaf0.npy", _npy("{'descr': '<f8', 'fortran_order': False, "
                                               "'shape': (1000000000000,), }")),
    ):  # fmt: skip
        damage()
        with pytest.raises(ValueError, match="^io.leaves: .* is damaged"):
            io.leaves(file)
        file.rename(tmp_path / "b.npz")
        assert Store(tmp_path).read("b") is None


def _entry(file, name, content):
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(name, content)


def _npy(header):
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


@pytest.mark.stress(58)
@pytest.mark.parametrize(
    "like",
    [jnp.zeros(5), jnp.zeros((3, 1)), jnp.zeros(()), jnp.zeros(3, int), np.zeros(3, "f4")],
)
def test_numbers_of_another_shape_or_type_are_refused(tmp_path, like):
    io.save(tmp_path / "a.npz", {"a": jnp.arange(3.0)})
    with pytest.raises(ValueError, match=r"`\['a'\]` as float64 of shape \(3,\), `like` needs"):
        io.load(tmp_path / "a.npz", {"a": like})


def test_short_floats_come_back(tmp_path):
    tree = {"a": jnp.arange(3, dtype=jnp.bfloat16), "b": np.zeros((2, 0)), "c": jnp.ones(())}
    io.save(tmp_path / "a.npz", tree)
    back = io.load(tmp_path / "a.npz", tree)
    assert back["a"].dtype == jnp.bfloat16 and jnp.array_equal(back["a"], tree["a"])
    assert back["b"].shape == (2, 0) and back["c"] == 1


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
        SE2(),
        R.constant("kappa_z"),
        R.circle(r),
        length=x,
        young_modulus=1e6,
        poisson_ratio=y,
        density=1000.0,
    )
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
