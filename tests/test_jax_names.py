"""Without names that JAX does not promise: the same tests pass, and `sorojax info` says it."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from sorojax import _jax
from sorojax._jax.optional import SWITCH, optional, reason
from sorojax._jax.versions import is_tested

pytestmark = pytest.mark.versions
ROOT = Path(__file__).parent.parent
TESTS = (
    "tests/test_jax_operations.py", "tests/test_jax_trace_state.py", "tests/test_jax_jit.py",
    "tests/test_jax_programs.py", "tests/test_jax_small_products.py",
    "tests/test_jax_diffrax_checks.py",
    "tests/test_systems.py::test_an_adaptive_run_is_differentiable_backwards",
    "tests/test_fem.py::test_gradient_of_a_prescribed_displacement",
    "tests/test_fem.py::test_second_derivatives_of_equilibrium",
    "tests/test_rod.py::test_batches_agree_with_single_calls",
)  # fmt: skip


def run(without, *command):
    return subprocess.run(
        [sys.executable, *command],
        cwd=ROOT,
        env=os.environ | {SWITCH: without},
        capture_output=True,
        text=True,
    )


@pytest.mark.skipif(not is_tested(jax.__version__), reason="a jax that was not tested yet")
def test_every_fast_path_is_on_where_jax_was_tested():
    """Tests of a fast path that is off are left out: none is, on a tested jax."""
    assert set(_jax.fast_paths().values()) == {"on"}


def test_the_same_tests_pass_by_public_names_alone():
    done = run("all", "-m", "pytest", "-q", "-p", "no:cacheprovider", *TESTS)
    assert done.returncode == 0, done.stdout[-3000:]


ROOMS = {
    "jax.interpreters.mlir.emit_python_callback": {"host_call"},
    "jax.extend.core.Primitive": {"host_call", "operations", "small_products"},
    "jax.extend.core.Literal": {"programs", "small_kernels"},
    "jax.extend.core.Var": {"programs"},
    "jax.experimental.xla_metadata.set_xla_metadata": {"small_kernels"},
    "jax.core.eval_jaxpr": {"small_kernels", "small_products"},
    "jax.extend.core.get_opaque_trace_state": {"trace_state"},
}
INFO = """
from sorojax._jax import fast_paths
print(*(f"{name}={state}" for name, state in fast_paths().items()), sep=";")
"""


@pytest.mark.parametrize("name", ROOMS)
def test_one_name_that_is_missing_switches_its_paths_off(name):
    said = dict(pair.split("=", 1) for pair in run(name, "-c", INFO).stdout.strip().split(";"))
    assert said.keys() == _jax.fast_paths().keys()
    changed = {room for room, state in _jax.fast_paths().items() if said[room] != state}
    assert changed == ROOMS[name]
    assert all(f"{SWITCH} leaves it out" in said[room] for room in ROOMS[name])


def test_a_name_that_this_jax_does_not_have():
    assert optional("jax.core", "no_such_name") is None
    assert optional("jax.no_such_module", "Name") is None
    assert reason("jax.core", "no_such_name") == "this jax has no jax.core.no_such_name"
