"""States, motions and results in files: every bit back, nothing executed."""

import hashlib
import io
import json
import os
import zipfile
import zlib
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax.io import _files

FORMAT = 1
_HEADER = "sorojax.json"
Tree = TypeVar("Tree")


def save(path: str | os.PathLike, tree: Any, *, root: str | os.PathLike | None = None) -> None:
    """Write the arrays of any noun, state or motion to a file.

    The file is a zip of plain arrays with a header of names, shapes, types and checksums.
    It appears whole or not at all.

    Args:
        path: File name, usually `*.npz`.
        tree: Any pytree; what is no array (names, counts, functions) is not written.
        root: Folder that the file must lie in.
    """
    target = _files.inside("io.save", path, root)
    arrays = {name: _plain(leaf) for name, leaf in _leaves(tree).items()}
    header = {
        "format": FORMAT,
        "leaves": {
            name: {"shape": a.shape, "dtype": str(a.dtype), "sha256": _digest(a)}
            for name, a in arrays.items()
        },
    }

    def fill(file):
        text = np.frombuffer(json.dumps(header).encode(), np.uint8)
        numbered = {f"leaf{k}": a for k, a in enumerate(arrays.values())}
        np.savez(file, allow_pickle=False, **{_HEADER: text, **numbered})

    _files.write(target, fill)


def load(
    path: str | os.PathLike,
    like: Tree,
    *,
    root: str | os.PathLike | None = None,
    max_bytes: int = _files.MAX_BYTES,
) -> Tree:
    """Read what `save` wrote into the structure of `like`.

    Args:
        path: File name.
        like: A tree of the same structure; its numbers are replaced, the rest is kept.
        root: Folder that the file must lie in.
        max_bytes: Larger files, and files that unpack to more, are refused.

    Raises:
        ValueError: If the file is damaged, newer than this version, or of another structure.
    """
    target = _files.inside("io.load", path, root)
    content = _files.read("io.load", target, max_bytes)
    header, arrays = _unpack(target, content, max_bytes)
    wanted = _leaves(like)
    _need_same(target, header["leaves"], wanted)
    found = dict(zip(header["leaves"], arrays, strict=True))
    for name, array in found.items():
        entry = header["leaves"][name]
        same = str(array.dtype) == entry["dtype"] and list(array.shape) == entry["shape"]
        if not same or _digest(array) != entry["sha256"]:
            raise ValueError(_damaged(target, f"`{name}` differs from its checksum"))

    def put(where, leaf):
        if not eqx.is_array(leaf):
            return leaf
        return _like(found[jax.tree_util.keystr(where)], leaf)

    return jax.tree_util.tree_map_with_path(put, like)


def leaves(
    path: str | os.PathLike,
    *,
    root: str | os.PathLike | None = None,
    max_bytes: int = _files.MAX_BYTES,
) -> dict[str, np.ndarray]:
    """The arrays of a file of `save` by name, to look into it without the noun.

    Args:
        path: File name.
        root: Folder that the file must lie in.
        max_bytes: Larger files, and files that unpack to more, are refused.

    Raises:
        ValueError: If the file is damaged or newer than this version.
    """
    target = _files.inside("io.leaves", path, root)
    header, arrays = _unpack(target, _files.read("io.leaves", target, max_bytes), max_bytes)
    return dict(zip(header["leaves"], arrays, strict=True))


def _leaves(tree: Any) -> dict[str, Any]:
    pairs = jax.tree_util.tree_flatten_with_path(eqx.filter(tree, eqx.is_array))[0]
    return {jax.tree_util.keystr(where): leaf for where, leaf in pairs}


def _plain(leaf: Any) -> np.ndarray:
    is_key = isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if is_key else leaf)


def _like(array: np.ndarray, leaf: Any) -> Any:
    if isinstance(leaf, np.ndarray):
        return array
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.asarray(array), impl=jax.random.key_impl(leaf))
    return jnp.asarray(array)


def _digest(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


#: What the libraries raise at a file that is no archive of arrays, or a damaged one.
_BROKEN = (
    zipfile.BadZipFile, zlib.error, EOFError, KeyError, OSError, RuntimeError, TypeError,
    ValueError,
)  # fmt: skip


def _unpack(target, content: bytes, max_bytes: int) -> tuple[dict, list[np.ndarray]]:
    """Header and arrays; the size that is declared is checked before anything unpacks."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
    except _BROKEN as error:
        raise ValueError(_damaged(target, str(error))) from error
    if size > max_bytes:
        raise ValueError(
            f"io.load: {target} unpacks to {size} bytes, the limit is {max_bytes}. Raise "
            "`max_bytes` if you trust it and have the memory."
        )
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            header = json.loads(file[_HEADER].tobytes())
            arrays = [file[f"leaf{k}"] for k in range(len(header["leaves"]))]
        version = int(header["format"])
    except _BROKEN as error:
        raise ValueError(_damaged(target, str(error))) from error
    if version > FORMAT:
        raise ValueError(
            f"io.load: {target} has format {version}, this version reads up to {FORMAT}. "
            "Update sorojax."
        )
    return header, arrays


def _need_same(target, leaves: dict, wanted: dict) -> None:
    missing, extra = wanted.keys() - leaves.keys(), leaves.keys() - wanted.keys()
    if missing or extra:
        raise ValueError(
            f"io.load: {target} holds {sorted(leaves)}, `like` needs {sorted(wanted)}. Give a "
            "tree of the structure that was saved."
        )


def _damaged(target, why: str) -> str:
    return f"io.load: {target} is damaged ({why}), need a file of io.save. Write it again."
