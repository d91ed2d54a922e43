"""Memory mappings that compiled programs take: seen, told before they run out."""

import sys
import warnings

import jax
import jax.numpy as jnp
import pytest

import sorojax.rod  # noqa: F401, begins to watch
from sorojax import _mappings as mappings

pytestmark = [
    pytest.mark.versions,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux counts mappings"),
]


def test_every_program_is_seen():
    before = mappings._state["programs"]
    jax.jit(lambda x: jnp.cos(x) + 0.123456789)(jnp.arange(3.0))
    assert mappings._state["programs"] > before
    assert mappings.count() > 50


def test_it_is_told_once_until_programs_are_dropped():
    taken = mappings.count()
    few, many = taken, 100 * taken
    mappings.look(many)
    with pytest.warns(
        UserWarning, match=r"take \d+ memory mappings, need less than .*clear_caches"
    ):
        mappings.look(few)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mappings.look(few)
        mappings.look(many)
    with pytest.warns(UserWarning):
        mappings.look(few)
    mappings.look(many)


def test_a_look_follows_a_number_of_programs(monkeypatch):
    looks = []
    monkeypatch.setattr(mappings, "look", lambda: looks.append(1))
    for _ in range(2 * mappings._EVERY):
        mappings._after(mappings._COMPILED, 0.0)
    mappings._after("another event", 0.0)
    assert len(looks) == 2
