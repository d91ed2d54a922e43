"""Programs compiled by themselves: the same numbers, loops in one kernel, what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sorojax as sj
from sorojax.math import jit as module, one_kernel as kernels

X = jnp.linspace(0.1, 0.9, 6)


@pytest.fixture(autouse=True)
def _asked_for(monkeypatch):
    monkeypatch.setenv("SOROJAX_ONE_KERNEL", "1")


def elementwise(_, x):
    """All that one kernel may hold, of numbers between 0 and 1."""
    odd = [jnp.arcsin, jnp.arctan, jnp.arctanh, jnp.cbrt, jnp.sin, jnp.sinh, jnp.tan, jnp.tanh,
           jnp.expm1, jnp.log1p, jax.lax.erf, jax.lax.erf_inv, jnp.square]  # fmt: skip
    even = [jnp.arccos, jnp.cos, jnp.cosh, jnp.exp, jnp.exp2, jnp.log, jnp.sqrt, jax.lax.rsqrt,
            jax.lax.erfc, jax.lax.logistic, jnp.arcsinh, jnp.floor, jnp.ceil, jnp.round,
            jnp.sign, jnp.abs, lambda x: jnp.arccosh(1 + x), lambda x: x**0.3, lambda x: x**3,
            lambda x: jnp.arctan2(x, 1 + x), lambda x: jax.lax.rem(3 * x, x + 0.5),
            lambda x: jnp.nextafter(x, 2 * x), lambda x: jnp.clip(x, 0.2, 0.7)]  # fmt: skip
    total = sum(f(x) for f in [*odd, *even])
    return 0.05 + 0.9 * jax.nn.sigmoid(total - 20)


def structural(i, x):
    """Products, parts, reductions, inner loops."""
    table = jnp.outer(x, x) @ jnp.linspace(0.0, 1.0, 36).reshape(6, 6)
    low = jax.lax.while_loop(lambda s: jnp.sum(s) > 1, lambda s: s / 2, x)
    turned = jax.lax.scan(lambda c, row: (c * 0.5 + row[::-1], c), low, table)
    picked = jnp.where(i % 2 == 0, jnp.flip(turned[0]), turned[0])
    parts = [jnp.max(picked), jnp.min(table), jnp.prod(1 + picked), jnp.cumsum(picked)[i % 6]]
    marks = jnp.any(picked > 0.3) & ~jnp.all(jnp.isfinite(picked) ^ (picked < 0))
    ends = jnp.stack([*parts, jnp.where(marks, 1.0, 2.0), jnp.argmax(picked).astype(x.dtype)])
    padded = jnp.pad(jnp.tile(ends, 2)[3:8], (0, 1)).reshape(2, 3).T.reshape(6)
    moved = jax.lax.dynamic_update_slice(padded, picked[:2], (i % 3,))
    return 0.5 * jnp.tanh(moved) + 0.1 * turned[1][i % 6] + 0.1 * x


def with_library(_, x):
    """Too much for a kernel."""
    return jnp.linalg.solve(2 * jnp.eye(6) + jnp.outer(x, x), jnp.sin(x))


def text(function, *args):
    program = jax.jit(kernels.one_kernel(function), compiler_options=kernels.OPTIONS)
    return program.lower(*args).compile().as_text()


def entry(text):
    return text[text.index("ENTRY") :]


@pytest.mark.parametrize("body", [elementwise, structural, with_library])
def test_the_numbers_are_those_of_the_plain_program(body):
    def run(x):
        return jax.lax.fori_loop(0, 5, body, x)

    plain, alone = jax.jit(run)(X), sj.jit(run)(X)
    assert np.allclose(alone, plain, rtol=1e-13, atol=1e-15)
    compiled = text(run, X)
    assert (" while(" in entry(compiled)) is (body is with_library)
    assert ("small_call" in entry(compiled)) is (body is not with_library)


def test_loops_over_large_arrays_and_long_ones_stay_as_they_are(monkeypatch):
    def run(x):
        return jax.lax.fori_loop(0, 5, lambda _, x: x + jnp.sin(x), x)

    assert "xla_cpu_small_call" not in text(run, jnp.ones(kernels.LARGEST + 1))
    monkeypatch.setattr(kernels, "LONGEST", 1)
    assert 'small_call="true"' not in entry(text(run, jnp.ones(500)))


def test_inside_other_programs_it_is_part_of_them():
    traces = []

    @sj.jit
    def run(x, count, name="sum"):
        traces.append(name)
        return jax.lax.fori_loop(0, count, lambda _, x: x + jnp.sin(x), x), name

    first, name = run(X, 3)
    assert name == "sum"
    run(X + 1, 3)
    assert len(traces) == 1  # one structure, one trace
    assert run(X, 4, name="other")[1] == "other"
    slope = jax.jit(jax.vmap(jax.grad(lambda x: jnp.sum(run(x, 3)[0]))))(jnp.stack([X, X]))
    assert np.allclose(jax.jit(lambda: run(X, 3)[0])(), first)
    direct = sj.jit(jax.grad(lambda x: jnp.sum(run(x, 3)[0])))(X)
    assert np.allclose(slope[1], direct, rtol=1e-13)


def test_what_the_compiler_refuses_is_compiled_as_usual(monkeypatch):
    monkeypatch.setattr(module, "OPTIONS", {"xla_no_such_option": True})

    def run(x):
        return jax.lax.fori_loop(0, 3, lambda _, x: x + jnp.cos(x), x)

    want = jax.jit(run)(X)
    call = sj.jit(run)
    assert np.allclose(call(X), want)
    assert np.allclose(call(X), want)
    assert np.allclose(sj.compiled(run, X)(X), want)


def test_a_program_for_real_time_takes_arguments_like_its_examples():
    step = sj.compiled(lambda x, h: {"x": x - h * jnp.sin(x)}, X, 0.1)
    want = X - 0.2 * jnp.sin(X)
    for x, h in ((X, jnp.array(0.2)), (np.asarray(X), 0.2), (X, np.float64(0.2))):
        assert np.allclose(step(x, h)["x"], want, rtol=1e-15)
    with pytest.raises(ValueError, match=r"shape \(5,\), need \(6,\). Compile once more"):
        step(X[1:], 0.1)
    with pytest.raises(ValueError, match="arguments of the structure"):
        step(X)
    with pytest.raises(TypeError, match="got 'fast' among the arguments.*Close over"):
        sj.compiled(lambda x, name: x, X, "fast")


def test_arguments_that_a_loop_does_not_use_and_branches():
    def run(x, unused, flag):
        def body(_, state):
            x, kept, count = state
            x = jax.lax.cond(flag, lambda: jnp.sin(x), lambda: jnp.zeros_like(x))
            return x + 0.1, kept, count + 1

        def plain(state):
            return state[0] * 0.5, state[1], state[2] + 1

        state = jax.lax.fori_loop(0, 3, body, (x, unused, 0))
        state = jax.lax.while_loop(lambda s: s[2] < 9, plain, state)

        def dead(carry, row):
            return carry + 1.0, None

        end, _ = jax.lax.scan(dead, x, (unused, jnp.arange(6)))
        return state[0] + end, state[1]

    args = X, jnp.arange(6.0), jnp.array(True)
    assert "xla_cpu_small_call" in text(run, *args)
    for got, want in zip(sj.jit(run)(*args), jax.jit(run)(*args), strict=True):
        assert np.allclose(got, want, rtol=1e-14)
