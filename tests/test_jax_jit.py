"""Programs compiled by themselves: the same numbers, loops in one kernel, what is refused."""

import re

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sorojax as sj
from sorojax import rod as R
from sorojax._jax import jit as module, small_kernels as kernels
from sorojax.math.ode.explicit import Tsit5
from sorojax.systems import Markers, ShapeFilter, start_filter, update_filter

pytestmark = pytest.mark.versions
X = jnp.linspace(0.1, 0.9, 6)
marked = pytest.mark.skipif(not kernels._IS_PROVEN, reason=kernels.status())


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
    return jnp.linalg.eigvalsh(2 * jnp.eye(6) + jnp.outer(x, x)) / 3 + jnp.sin(x)


def compiled(function, *args):
    program = jax.jit(kernels.one_kernel(function), compiler_options=kernels.OPTIONS)
    return program.lower(*args).compile()


def text(function, *args):
    return str(compiled(function, *args).as_text())


def has_mark(function, *args):
    """Before compilation: XLA makes kernels of some loops by itself."""
    return "xla_cpu_small_call" in jax.jit(kernels.one_kernel(function)).lower(*args).as_text()


def entry(text):
    return text[text.index("ENTRY") :]


@marked
@pytest.mark.parametrize("body", [elementwise, structural, with_library])
def test_the_numbers_are_those_of_the_plain_program(body):
    def run(x):
        return jax.lax.fori_loop(0, 5, body, x)

    plain, alone = jax.jit(run)(X), sj.jit(run)(X)
    assert np.allclose(alone, plain, rtol=1e-13, atol=1e-15)
    main = entry(text(run, X))
    assert (" while(" in main) is (body is with_library)
    assert ("small_call" in main) is (body is not with_library)


@marked
def test_loops_over_large_arrays_and_long_ones_stay_as_they_are(monkeypatch):
    def run(x):
        return jax.lax.fori_loop(0, 5, lambda _, x: x + jnp.sin(x), x)

    assert has_mark(run, jnp.ones(500)) and not has_mark(run, jnp.ones(kernels.LARGEST + 1))
    monkeypatch.setattr(kernels, "LONGEST", 1)
    assert not has_mark(run, jnp.ones(500))


@marked
@pytest.mark.parametrize("outer", ["scan", "while"])
def test_loops_within_a_loop_that_no_kernel_can_hold_are_kernels(outer):
    def inner(x):
        return jax.lax.fori_loop(0, 5, lambda _, x: 0.5 * x + jnp.sin(x), x)

    def turn(x):
        spread = jnp.linalg.eigvalsh(jnp.diag(2.0 + inner(x)))  # by a library
        return inner(0.1 * x) / spread

    def run(x):
        if outer == "scan":
            return jax.lax.scan(lambda x, row: (turn(x) + row, x), x, jnp.ones((4, 3)))
        return jax.lax.while_loop(lambda x: x[0] < 9, lambda x: x + jnp.abs(turn(x)) + 1, x)

    x = jnp.array([0.2, 0.5, 0.9])
    assert has_mark(run, x)
    found, want = compiled(run, x)(x)[0], jax.jit(run)(x)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-13)


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


@marked
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


@marked
def test_no_kernel_has_an_argument_that_it_could_do_without():
    """The compiler ends the process where one does, at times: constants, once found, and
    states that a loop forgets are the ways to it."""
    table = jnp.linspace(0.0, 1.0, 600)

    def run(x, count):
        found = 0 * count + jnp.arange(3)  # a constant, but not by its looks
        part = jax.lax.fori_loop(
            0, 4, lambda i, s: s + table[:6] * jnp.sum(found).astype(s.dtype), x
        )
        forgets = jax.lax.while_loop(
            lambda s: s[0], lambda s: (jnp.array(False), s[1] * 0 + 2), (count > 0, count)
        )

        @jax.jit
        def inner(x, unused):
            return jnp.cumsum(x) * table[2]

        known = jax.lax.fori_loop(0, 3, lambda i, s: jnp.sin(s) + i, 0.5)
        rows = known * jnp.ones((5, 6))
        end, rest = jax.lax.scan(lambda s, row: (inner(s, row), row), part, rows)
        slope = jax.grad(lambda x: jnp.sum(jax.lax.fori_loop(0, 3, lambda _, s: 2 * s, x)))(x)
        return end, rest, forgets, slope

    args = X, jnp.array(2)
    assert not list(unused_arguments(text(run, *args)))
    alone, plain = (jax.tree.leaves(f(run)(*args)) for f in (sj.jit, jax.jit))
    for got, want in zip(alone, plain, strict=True):
        assert np.allclose(got, want, rtol=1e-13)


def unused_arguments(text):
    """Arguments of computations inside of kernels that nothing there uses."""
    bodies = {}
    for line in text.splitlines():
        if head := re.match(r"(?:ENTRY )?%?([\w.\-]+) .*\{$", line):
            lines = bodies[head.group(1)] = []
        elif " = " in line:
            lines.append(line)
    calls = [
        line
        for lines in bodies.values()
        for line in lines
        if " call(" in line and 'small_call="true"' in line
    ]
    assert calls
    reached = inside(calls)
    for name in reached:
        reached += [each for each in inside(bodies[name]) if each not in reached]
        for line in bodies[name]:
            argument = re.match(r"\s*(%[\w.\-]+) = .* parameter\(", line)
            if argument and not uses(bodies[name], argument.group(1)):
                yield name, argument.group(1)


def inside(lines):
    """Computations that are called; what reduces has arguments of its own kind."""
    found = re.findall(r"(?:body|condition|to_apply)=(%?[\w.\-]+)", "\n".join(lines))
    return [name.lstrip("%") for name in found if "reduce" not in name]


def uses(lines, name):
    return [line for line in lines if re.search(re.escape(name) + r"[,)]", line)]


@marked
def test_a_filter_with_constants_among_its_arguments_compiles():
    """It once ended the process."""
    model = R.rod(
        sj.SE2(),
        R.chebyshev(kappa_z=1),
        R.circle(6e-3),
        nodes=4,
        length=0.08,
        young_modulus=1e6,
        poisson_ratio=0.3,
        density=1100.0,
    )
    at = jnp.array([0.5, 1.0])
    estimator = ShapeFilter(Markers(model, at), 1 / 60)
    seen = R.forward_kinematics(model, jnp.array([3.0]), at)[:, :2, 2]

    def update(last, seen):
        return update_filter(estimator, last, seen, forces=(R.Damping(0.01),)).q

    begin = start_filter(estimator)
    program = compiled(update, begin, seen)
    assert not list(unused_arguments(program.as_text()))
    assert np.allclose(program(begin, seen)[0], update(begin, seen), rtol=1e-9)


def test_an_error_of_the_program_does_not_run_it_again():
    """Whatever its words: those of a callback may be those of a compiler."""
    runs = []

    def fails(x):
        runs.append(x)
        raise ValueError("Unsupported")

    @sj.jit
    def run(x):
        return jax.pure_callback(fails, jax.ShapeDtypeStruct((), x.dtype), x[0])

    with pytest.raises(Exception, match="Unsupported"):
        jax.block_until_ready(run(X))
    assert len(runs) == 1


def test_a_jaxlib_that_was_not_tried_gets_the_plain_program(monkeypatch):
    monkeypatch.setattr(kernels, "_JAXLIB", "0.99.0")
    assert kernels.status().startswith("off: not proven on jaxlib 0.99.0")
    monkeypatch.setattr(kernels, "_IS_PROVEN", kernels.status() == "on")
    assert not kernels.runs_alone(X)
    found = sj.jit(lambda x: jax.lax.fori_loop(0, 3, lambda _, x: x + jnp.cos(x), x))(X)
    assert found.shape == X.shape


@marked
@pytest.mark.parametrize("batched", [False, True], ids=["one", "many"])
def test_an_adaptive_run_is_one_kernel(batched):
    def swing(gravity):
        def field(t, state, _):
            return {"x": state["v"], "v": -gravity * jnp.sin(state["x"]) + 0.1 * jnp.cos(t)}

        start = {"x": jnp.array([1.0, 0.3]), "v": jnp.zeros(2)}
        control = dfx.PIDController(rtol=1e-6, atol=1e-8)
        run = dfx.diffeqsolve(
            dfx.ODETerm(field), Tsit5(), 0.0, 2.0, 0.01, start, stepsize_controller=control
        )
        return run.ys, run.stats["num_steps"]

    function, x = (jax.vmap(swing), jnp.array([9.0, 5.0])) if batched else (swing, X[-1] * 10)
    assert has_mark(function, x)
    (found, steps), (exact, count) = sj.jit(function)(x), jax.jit(function)(x)
    assert jnp.array_equal(steps, count)
    for name in ("x", "v"):
        np.testing.assert_allclose(found[name], exact[name], rtol=0, atol=1e-12)


@marked
@pytest.mark.parametrize("run", ["acceleration", "rollout"])
def test_loops_over_the_dynamics_of_a_rod_are_kernels(run):
    """Whose functions have rules of their own for derivatives and lanes."""
    body = R.rod(
        sj.SE2(),
        R.chebyshev(kappa_z=2),
        R.circle(5e-3),
        length=0.1,
        young_modulus=1e6,
        poisson_ratio=0.5,
        density=1e3,
    )
    weight = (R.Gravity(),)

    def loop(q):
        def one(_, q):
            return q + 1e-9 * R.forward_dynamics(body, q, 0.0 * q, weight)

        if run == "acceleration":
            return jax.lax.fori_loop(0, 5, one, q)
        return R.rollout(body, q, 0.0 * q, weight, step=1e-3, saves=4, every=2).q[-1]

    assert has_mark(loop, X[:2])
    np.testing.assert_allclose(sj.jit(loop)(X[:2]), jax.jit(loop)(X[:2]), rtol=1e-10)
