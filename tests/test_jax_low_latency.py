"""JAX that answers in the thread that asks."""

import os
import subprocess
import sys

import pytest

from sorojax._jax import low_latency

pytestmark = pytest.mark.versions

PROGRAM = """
import resource
import jax
import numpy as np
import sorojax as sj
{asked}
f, x = jax.jit(lambda x: x @ x @ x @ x @ x @ x @ x @ x), np.eye(64, dtype=np.float32)
jax.block_until_ready(f(x))
before = resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw
for _ in range(300):
    jax.block_until_ready(f(x))
print(resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw - before)
"""


def run(asked: str):
    return subprocess.run(
        [sys.executable, "-c", PROGRAM.format(asked=asked)],
        capture_output=True,
        text=True,
        env=os.environ | {"NPROC": "2", "PJRT_NPROC": "2"},
    )


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts the waits of one thread")
def test_no_call_waits_for_another_thread():
    waits = [int(run(asked).stdout) for asked in ("", "sj.enable_low_latency()")]
    assert waits[0] > 60 and waits[1] < 10


@pytest.mark.skipif(
    low_latency._has_started is None, reason="this JAX does not tell that it runs"
)
def test_it_is_refused_once_jax_has_started():
    done = run("jax.numpy.ones(3); sj.enable_low_latency()")
    assert done.returncode != 0 and "JAX has started already" in done.stderr
    assert run("sj.enable_low_latency(); sj.enable_low_latency()").returncode == 0
