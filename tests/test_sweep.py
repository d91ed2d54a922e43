"""Sweeps: the same result hash whatever dies on the way."""

import functools
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import _progress, envs, sweep as W

ROOT = Path(__file__).parent.parent
DESIGNS = {"x": np.linspace(0.0, 1.0, 30), "n": np.arange(30)}
CHUNK = 3  # ten chunks


def work(block, config):
    """A chunk that leaves a line in a log before it computes."""
    with open(config["log"], "a") as log:
        log.write(f"{block['n'][0]}\n")
    time.sleep(float(os.environ.get("SWEEP_DELAY", "0")))
    return {"y": np.sin(block["x"]) * block["n"], "n": block["n"] ** 2}


def noise(block, seed):
    return {"y": np.random.default_rng(seed).normal(size=block["x"].shape)}


def broken(block):
    if block["n"][0] >= 15:
        raise OSError("no licence")
    return {"y": block["x"]}


def short(block):
    return {"y": block["x"][:1]}


def run(folder, executor=None, **options):
    config = {"log": str(folder / "log")}
    store = W.Store(folder / "store")
    return W.sweep(work, DESIGNS, store, executor, chunk=CHUNK, config=config, **options)


def starts(folder):
    return [int(line) for line in (folder / "log").read_text().split()]


def damage(folder):
    """Overwrite some bytes of one result."""
    file = sorted((folder / "store").glob("*.npz"))[4]
    content = bytearray(file.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 64] = bytes(64)
    file.write_bytes(content)


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    folder = tmp_path_factory.mktemp("serial")
    return folder, run(folder)


def test_a_sweep_gives_what_the_function_gives(serial):
    _, swept = serial
    assert np.array_equal(swept.result["y"], np.sin(DESIGNS["x"]) * DESIGNS["n"])
    assert (swept.computed, swept.found, len(set(swept.keys))) == (10, 0, 10)


def test_a_second_sweep_computes_nothing_and_a_longer_one_what_is_new(serial):
    folder, first = serial
    again = run(folder)
    assert (again.computed, again.found, again.hash) == (0, 10, first.hash)
    longer = {"x": np.linspace(0.0, 1.0, 30), "n": np.arange(30)}
    longer = {name: np.concatenate([v, v[:3] + 1]) for name, v in longer.items()}
    config = {"log": str(folder / "log")}
    more = W.sweep(work, longer, W.Store(folder / "store"), chunk=CHUNK, config=config)
    assert (more.computed, more.found) == (1, 10)


@pytest.mark.versions
def test_the_key_holds_code_config_designs_and_seed(tmp_path):
    store = W.Store(tmp_path)
    seen = [
        W.sweep(noise, DESIGNS, store, chunk=30, seed=seed, version=version)
        for seed, version in ((0, None), (1, None), (0, "other"), (0, None))
    ]
    assert [s.computed for s in seen] == [1, 1, 1, 0]
    assert seen[0].hash == seen[3].hash == seen[2].hash != seen[1].hash
    halves = W.sweep(noise, DESIGNS, store, chunk=15, seed=0)
    assert not np.array_equal(halves.result["y"][:15], halves.result["y"][15:])


def scaled(block, config):
    return {"y": block["x"] * np.asarray(config["gain"])[-1]}


def test_arrays_of_the_config_and_arguments_that_are_held_are_in_the_key(tmp_path):
    """Their text is cut short, so that other numbers would find the results of these."""
    store, gain = W.Store(tmp_path), np.ones(2000)
    other = np.concatenate([gain[:-1], [3.0]])
    middle = np.where(np.arange(2000) == 1000, 3.0, 1.0)
    assert repr(gain) == repr(middle)
    runs = [
        W.sweep(
            scaled, DESIGNS, store, chunk=30, config={"gain": jnp.asarray(g), "law": np.sin}
        )
        for g in (gain, middle, other, gain)
    ]
    assert [r.computed for r in runs] == [1, 1, 1, 0]
    assert np.array_equal(runs[2].result["y"], 3 * DESIGNS["x"])
    held = [
        W.sweep(functools.partial(scaled, config={"gain": g}), DESIGNS, store, chunk=30)
        for g in (gain, other, gain)
    ]
    assert [r.computed for r in held] == [1, 1, 0]
    keys = [
        W.sweep(
            scaled, DESIGNS, store, chunk=30, config={"gain": gain, "key": jax.random.key(k)}
        )
        for k in (0, 1, 0)
    ]
    assert [r.computed for r in keys] == [1, 1, 0]


def ended(block, config):
    """Distance [m] of the tip from the target after three steps, of members by number."""
    task, policy, key = config["task"], config["policy"], config["key"]
    params = task.default_params()

    def one(number):
        first, *later = jax.random.split(jax.random.fold_in(key, number), 4)
        state, seen = envs.reset(task, first, params)
        for own in later:
            after = envs.step(task, own, state, policy @ seen, params)
            state, seen = after.state, after.observation
        return after.info["distance"]

    return {"distance": jax.jit(jax.vmap(one))(jnp.asarray(block))}


def test_rollouts_of_a_policy_go_on_to_the_bit_and_another_policy_has_its_own(tmp_path):
    task = envs.FingerReach(time_step=4e-3, substeps=2, max_steps=4)
    shape = task.num_actions, task.num_observations
    config: dict = {"task": task, "key": jax.random.key(5)}
    config["policy"] = 0.05 * jax.random.normal(jax.random.key(0), shape)
    store = W.Store(tmp_path)
    found = [W.sweep(ended, np.arange(8), store, chunk=4, config=config) for _ in range(2)]
    again = W.sweep(ended, np.arange(12), store, chunk=4, config=config)
    assert (found[0].hash, found[0].computed, found[1].computed) == (found[1].hash, 2, 0)
    assert (again.computed, again.found) == (1, 2)
    assert np.array_equal(again.result["distance"][:8], found[0].result["distance"])
    softer = {**config, "policy": 2 * config["policy"]}
    other = W.sweep(ended, np.arange(8), store, chunk=4, config=softer)
    assert other.computed == 2 and other.hash != found[0].hash


def test_a_damaged_file_is_made_again(tmp_path, serial):
    run(tmp_path)
    damage(tmp_path)
    again = run(tmp_path)
    assert (again.computed, again.found, again.hash) == (1, 9, serial[1].hash)


def test_failures_keep_what_is_done_and_say_so(tmp_path):
    store = W.Store(tmp_path)
    with pytest.raises(RuntimeError, match="5 of 10 chunks .*no licence"):
        W.sweep(broken, DESIGNS, store, chunk=CHUNK, retries=2)
    assert len(list(tmp_path.glob("*.npz"))) == 5
    with pytest.raises(RuntimeError, match="leading axis of 3"):
        W.sweep(short, DESIGNS, store, chunk=CHUNK)
    with pytest.raises(ValueError, match="one axis"):
        W.sweep(work, {"x": np.zeros(3), "n": np.zeros(2)}, store)


def test_progress_is_told(tmp_path):
    told = []
    with _progress.listen(lambda p: told.append((p.label, p.done, p.total))):
        run(tmp_path)
    assert told[-1] == ("sweep", 10, 10) and len(told) == 11


@pytest.mark.versions
def test_a_process_pool_gives_the_same_hash(tmp_path, serial):
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        swept = run(tmp_path, pool)
    assert (swept.computed, swept.hash) == (10, serial[1].hash)


DRIVER = """
import os, signal
from pathlib import Path
from sorojax import _progress, sweep as W
from tests.test_sweep import run

if __name__ == "__main__":
    client = W.dask_local(workers=2)
    pids = list(client.run(os.getpid).values())
    deadly, killed = {deadly}, []

    def watch(progress):
        if deadly and progress.done >= 2 and not killed:
            killed.append(pids[0])
            os.kill(pids[0], signal.SIGKILL)
        if deadly and progress.done >= 5:
            print("killed", *pids, flush=True)
            os.kill(os.getpid(), signal.SIGKILL)

    with _progress.listen(watch):
        swept = run(Path({folder!r}), client)
    print("swept", swept.computed, swept.found, swept.hash, flush=True)
    client.shutdown()
"""


@pytest.mark.slow
def test_dask_survives_killed_workers_a_killed_driver_and_a_damaged_file(tmp_path, serial):
    def drive(deadly):
        script = tmp_path / "driver.py"
        script.write_text(DRIVER.format(folder=str(tmp_path), deadly=deadly))
        return subprocess.run(
            [sys.executable, str(script)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=200,
            env={**os.environ, "PYTHONPATH": str(ROOT), "SWEEP_DELAY": "0.2"},
        )

    done = drive(True)
    assert done.returncode == -signal.SIGKILL and "killed" in done.stdout, done.stderr[-2000:]
    finished = len(list((tmp_path / "store").glob("*.npz")))
    assert 5 <= finished < 10
    damage(tmp_path)
    before = len(starts(tmp_path))
    done = drive(False)
    word, computed, found, hashed = done.stdout.split()
    assert word == "swept" and hashed == serial[1].hash, done.stderr[-2000:]
    assert int(computed) + int(found) == 10 and int(found) >= finished - 1
    assert len(starts(tmp_path)) - before == int(computed)
    assert before <= finished + 3  # chunks in the hands of one killed worker and of two more
