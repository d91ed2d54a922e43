"""`sweep`: one function over many designs in chunks, each computed once and kept in a folder
under a key of all that determines it.

Chunks run in anything with `submit(function, *args)` that returns a future. On one machine,
with processes:

    from concurrent.futures import ProcessPoolExecutor
    sweep(function, designs, store, ProcessPoolExecutor(mp_context=get_context("spawn")))

Workers need the precision of their driver: set JAX_ENABLE_X64=1 in the environment, which
they inherit. JAX makes pickled arrays single precision in a process without it.

With Dask, the official extra `sorojax[sweep]`, two lines locally and two for a queue:

    client = sweep.dask_local(workers=2)
    sweep(function, designs, store, client)

    cluster = dask_jobqueue.SLURMCluster(cores=4, memory="8GB"); cluster.scale(jobs=20)
    sweep(function, designs, store, distributed.Client(cluster))

Workers run what they are sent: who can reach a scheduler can run code on it. `dask_local`
listens on the loopback only. Beyond one machine use TLS, with keys of your own:
`distributed.security.Security(tls_ca_file=..., tls_client_cert=..., tls_client_key=...,
require_encryption=True)`, given to the cluster and to the client.
"""

import functools
import hashlib
import inspect
import json
import os
import re
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from sorojax import __version__, _progress
from sorojax.io import _files, state as _archive
from sorojax.io.state import Arrays as Arrays

_CHECK = "sha256"


@dataclass(frozen=True)
class Store:
    """Results in a folder that several drivers and workers may share.

    A file appears by renaming, so nobody reads half of one; a file whose content does not
    match its checksum counts as missing and is made again.

    Attributes:
        folder: Made at the first write.
        max_bytes: Larger files are refused.
    """

    folder: str | os.PathLike
    max_bytes: int = _files.MAX_BYTES

    def path(self, key: str) -> Path:
        return Path(self.folder) / f"{key}.npz"

    def write(self, key: str, result: Arrays) -> None:
        """Keep a result; a second one of the same key replaces the first."""
        target = self.path(key)
        target.parent.mkdir(parents=True, exist_ok=True)
        check = np.frombuffer(digest(result).encode(), np.uint8)
        named = {f"result.{name}": value for name, value in result.items()} | {_CHECK: check}
        _files.write(target, lambda file: _archive.write(file, named))

    def read(self, key: str) -> Arrays | None:
        """The result of a key; None if there is none, or a damaged one."""
        target = self.path(key)
        if not target.is_file():
            return None
        try:
            content = _files.read("sweep", target, self.max_bytes)
            found = _archive.read(content, self.max_bytes)
            check = found.pop(_CHECK).tobytes().decode()
        except (ValueError, KeyError, OSError):
            return None
        result = {name.removeprefix("result."): array for name, array in found.items()}
        return result if digest(result) == check else None


def digest(result: Arrays) -> str:
    """A hash of names, types, shapes and bits."""
    hashed = hashlib.sha256()
    for name in sorted(result):
        array = np.ascontiguousarray(result[name])
        hashed.update(json.dumps([name, str(array.dtype), array.shape]).encode())
        hashed.update(array.tobytes())
    return hashed.hexdigest()


# Where chunks run: anything with `submit(function, *args)` that returns a future


class Serial:
    """Runs every chunk at once, in this process."""

    def submit(self, function, /, *args: Any) -> Future:
        future: Future = Future()
        try:
            future.set_result(function(*args))
        except Exception as error:
            future.set_exception(error)
        return future


def dask_local(workers: int, **options: Any) -> Any:
    """A Dask client with worker processes of one thread on this machine's loopback.

    Needs `distributed`, the extra `sorojax[sweep]`. Close it: `client.shutdown()`.

    Args:
        workers: Number of processes.
        **options: Of `distributed.LocalCluster`.

    Returns:
        The client, for `sweep`.
    """
    from distributed import Client, LocalCluster

    cluster = LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        **{"dashboard_address": None, **options},
    )
    return Client(cluster)


# `sweep`: one function over many designs in chunks that are made once


_MODES = ("jax_enable_x64", "jax_default_matmul_precision")


@dataclass(frozen=True)
class Swept:
    """The results of a sweep.

    Attributes:
        result: Arrays by name, with the leading axis of the designs.
        keys: Of the chunks, in order.
        computed: Chunks that ran now.
        found: Chunks that were in the store.
        hash: Of all results, equal wherever and however often the sweep ran.
    """

    result: Arrays
    keys: tuple[str, ...]
    computed: int
    found: int
    hash: str

    def __repr__(self) -> str:
        arrays = (f"{name} {np.shape(values)}" for name, values in self.result.items())
        return (
            f"Swept: {', '.join(arrays)}; {self.computed} chunks computed, {self.found} found"
        )


def sweep(
    function: Callable[..., Mapping[str, Any]],
    designs: PyTree,
    store: Store,
    executor: Any = None,
    *,
    chunk: int = 64,
    config: Any = None,
    seed: int | None = None,
    version: str | None = None,
    retries: int = 3,
) -> Swept:
    """Call `function(block)` for blocks of designs, skipping those whose results are stored.

    Inside, `function` may use `vmap`, `simulate_batch` or `shard_map` over its block. With
    `config` it is called as `function(block, config)`; with `seed`, a last argument is a
    NumPy integer that differs from chunk to chunk.

    A chunk is known by the versions of code and JAX, the config, what a `functools.partial`
    holds, its designs and its seed:
    the same sweep again finds its results, also after a crash of driver or workers, and a
    longer one only computes what is new. Workers write results themselves.

    Args:
        function: Pure, importable by the workers; returns arrays by name, each with the
            leading axis of the block.
        designs: A pytree of arrays with a leading axis of designs, in the units of `function`.
        store: Where results are kept; a folder that all workers see.
        executor: Anything with `submit`: a process pool, a Dask client; one chunk after the
            other in this process by default.
        chunk: Designs per call.
        config: What else the result depends on, a pytree such as a rod or a policy: known by
            the bits of its arrays and the `repr` of all else. Nothing by default.
        seed: Seed of random results; none by default.
        version: Name of the code; by default the version of sorojax and the source of the
            function. Give one where the function calls code of your own that changes.
        retries: How often a chunk that fails is tried in all.

    Returns:
        Results of all designs by name, and how many chunks were computed and found.

    Raises:
        RuntimeError: If a chunk failed `retries` times; what is done stays in the store.
        ValueError: If the designs have no common leading axis, `chunk` is below 1, or the
            source of `function` cannot be read and no `version` is given.
        TypeError: If `executor` has no `submit`.

    Example:
        >>> def squares(block):
        ...     return {"square": block**2}
        >>> store = sweep.Store("results")
        >>> found = sweep.sweep(squares, np.arange(4.0), store, chunk=2, version="1")
        >>> found.result["square"].tolist()
        [0.0, 1.0, 4.0, 9.0]
    """
    blocks = _blocks(designs, chunk)
    code = _code(function) if version is None else version
    jobs, order = {}, []
    for number, block in enumerate(blocks):
        own = None if seed is None else _seed(seed, number)
        order.append(_key(code, (config, _given(function)), block, own))
        jobs.setdefault(order[-1], (block, tuple(x for x in (config, own) if x is not None)))
    results = {key: found for key in jobs if (found := store.read(key)) is not None}
    known = len(results)
    _progress.report("sweep", known, len(jobs))
    missing = {key: job for key, job in jobs.items() if key not in results}
    executor = Serial() if executor is None else executor
    if not hasattr(executor, "submit"):
        raise TypeError(
            f"sweep: got {executor!r} for `executor`, need something with `submit`. Leave it "
            "out, or give a concurrent.futures executor or sweep.dask_local(workers)."
        )
    _run_all(function, missing, results, store, executor, len(jobs), retries)
    parts = [results[key] for key in order]
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Swept(joined, tuple(order), len(missing), known, digest(joined))


def _run_all(function, missing, results, store, executor, total, retries) -> None:
    """Submit what is missing, collect it, and try again what fails."""
    failures: dict[str, list[BaseException]] = {key: [] for key in missing}

    def start(key: str):
        # the number of the attempt makes Dask forget a failure of the same call
        made = functools.partial(_make, function, store, key, len(failures[key]))
        return executor.submit(made, *missing[key])

    waiting = {key: start(key) for key in missing}
    while waiting:
        ready = [key for key, future in waiting.items() if future.done()]
        if not ready:
            time.sleep(0.005)
        for key in ready:
            error = waiting.pop(key).exception()
            found = store.read(key) if error is None else None
            if found is not None:
                results[key] = found
                _progress.report("sweep", len(results), total)
                continue
            why = error or OSError(f"its file {store.path(key)} is missing or damaged")
            failures[key].append(why)
            if len(failures[key]) >= retries:
                raise RuntimeError(
                    f"sweep: chunk {key[:12]} failed {retries} times, {len(results)} of "
                    f"{total} chunks are in the store. The last error: {why!r}. Mend the "
                    "cause and call sweep again: finished chunks are not computed twice."
                ) from error
            waiting[key] = start(key)


def _make(function, store: Store, key: str, attempt: int, block, extra) -> str:
    """Runs where the executor puts it; a chunk that is there already is not made again."""
    if store.read(key) is None:
        made = function(block, *extra)
        if not isinstance(made, Mapping):
            raise TypeError(
                f"sweep: the function returned {type(made).__name__}, need arrays by name. "
                'Return {"cost": ...}.'
            )
        result = {name: np.asarray(value) for name, value in made.items()}
        length = jax.tree.leaves(block)[0].shape[0]
        for name, value in result.items():
            if value.shape[:1] != (length,):
                raise ValueError(
                    f"sweep: `{name}` has shape {value.shape}, need a leading axis of "
                    f"{length} designs. Return one entry per design."
                )
        store.write(key, result)
    return key


def _blocks(designs: PyTree, chunk: int) -> list[PyTree]:
    if chunk < 1:
        raise ValueError(f"sweep: `chunk` must be 1 or more, got {chunk}.")
    designs = jax.tree.map(np.asarray, designs)
    lengths = {leaf.shape[:1] for leaf in jax.tree.leaves(designs)}
    if len(lengths) != 1 or lengths in ({()}, {(0,)}):
        raise ValueError(
            f"sweep: the leaves of `designs` have the leading axes {sorted(lengths)}, need one "
            "axis of one or more designs. Give arrays of one length."
        )
    ((count,),) = lengths
    return [
        jax.tree.map(lambda leaf, k=k: leaf[k : k + chunk], designs)
        for k in range(0, count, chunk)
    ]


def _seed(seed: int, number: int) -> np.integer:
    return np.random.SeedSequence([seed, number]).generate_state(1)[0]


def _code(function: Callable) -> str:
    """The version of sorojax and the source of the function."""
    while isinstance(function, functools.partial):
        function = function.func
    try:
        source = inspect.getsource(inspect.unwrap(function))
    except (OSError, TypeError):
        raise ValueError(
            f"sweep: the source of {function!r} cannot be read, so results could not be told "
            'apart when it changes. Name the code: version="...".'
        ) from None
    return f"{__version__} {source}"


def _given(function: Callable) -> list[Any]:
    """Arguments that partial functions hold."""
    held = []
    while isinstance(function, functools.partial):
        held.append([function.args, function.keywords])
        function = function.func
    return held


def _key(code: str, config: Any, block: PyTree, seed: Any) -> str:
    hashed = hashlib.sha256()
    modes = {name: str(jax.config.values[name]) for name in _MODES}
    about = [code, jax.__version__, modes, repr(seed)]
    hashed.update(json.dumps(about, sort_keys=True).encode())
    for tree in (config, block):
        _add(hashed, tree)
    return hashed.hexdigest()


def _add(hashed: Any, tree: PyTree) -> None:
    """Arrays by their bits, all else by its words, without places in memory."""
    leaves, structure = jax.tree.flatten(tree)
    arrays, others = {}, {}
    for number, leaf in enumerate(leaves):
        if not isinstance(leaf, np.ndarray | np.generic | jax.Array):
            others[number] = leaf
            continue
        if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        arrays[str(number)] = np.asarray(leaf)
    words = json.dumps([str(structure), others], sort_keys=True, default=repr)
    hashed.update(re.sub(" at 0x[0-9a-f]+", "", words).encode())
    hashed.update(digest(arrays).encode())
