"""Work side by side in threads."""

import threading

import jax
import jax.numpy as jnp
import pytest

from sorojax.math.host import together


def test_works_run_at_the_same_time_and_answer_in_order():
    met = threading.Barrier(3, timeout=20)

    def work(number):
        met.wait()
        return number

    assert together(*(lambda k=k: work(k) for k in range(3))) == [0, 1, 2]
    assert together(lambda: 4) == [4]


def test_threads_take_the_settings_of_the_caller():
    with jax.enable_x64(False):
        kinds = together(*[lambda: jnp.linspace(0.0, 1.0, 3).dtype] * 2)
    assert kinds == [jnp.float32] * 2
    device = jax.devices()[0]
    with jax.default_device(device):
        asked = together(*[lambda: jax.config.jax_default_device] * 2)
    assert asked == [device] * 2


def test_an_error_of_a_work_reaches_the_caller():
    def fail():
        raise ValueError("no such cell")

    with pytest.raises(ValueError, match="no such cell"):
        together(lambda: 1, fail)
