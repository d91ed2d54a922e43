"""One-step methods, alone and in diffrax, and the control of their steps."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax.math.ode.explicit import RungeKutta4, SemiImplicitEuler, Tsit5, repeated
from sorojax.math.ode.generalised_alpha import GeneralisedAlpha
from sorojax.math.ode.rosenbrock import Rodas4, Rosenbrock2
from sorojax.math.ode.step_control import Control, SearchedAttempt, cut


def repeat(*args):
    return repeated(*args)[0]


METHODS = (
    (Tsit5(), 5),
    (RungeKutta4(), 4),
    (Rodas4(), 4),
    (SemiImplicitEuler(), 1),
    (Rosenbrock2(), 2),
    (GeneralisedAlpha(), 2),
)
START = {"q": jnp.array([1.0, 0.5]), "v": jnp.array([0.0, 1.0])}


def swing(t, y):
    """A Mathieu oscillator with a cubic spring: nothing linear, nothing constant."""
    return {"q": y["v"], "v": -y["q"] * (1 + 0.5 * jnp.sin(3 * t)) - 0.2 * y["q"] ** 3}


@eqx.filter_jit
def solve(solver, control, start=START, adjoint=None, field=swing, end=1.0):
    return dfx.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: field(t, y)),
        solver,
        0.0,
        end,
        None,
        start,
        stepsize_controller=control,
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, end, 5)),
        adjoint=dfx.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        throw=False,
    )


@pytest.fixture(scope="module")
def exact():
    return solve(dfx.Dopri8(), dfx.PIDController(rtol=1e-13, atol=1e-14)).ys["q"]


@pytest.mark.parametrize("method, order", METHODS)
def test_fixed_steps_have_their_order(method, order, exact):
    @jax.jit
    def end(count):
        def one(k, carry):
            y, memory = carry
            new = method.advance(swing, k / count, y, 1 / count, memory)
            return new.y, new.memory

        first = (START, method.begin(swing, jnp.array(0.0), START, 1 / count))
        return jax.lax.fori_loop(0, count.astype(int), one, first)[0]["q"]

    errors = [float(jnp.abs(end(jnp.array(n)) - exact[-1]).max()) for n in (10.0, 20.0)]
    assert order - 0.25 < np.log2(errors[0] / errors[1]) < order + 0.6


@pytest.mark.parametrize("method", [Tsit5(), Rodas4()])
def test_adaptive_runs_hold_their_tolerance_within_steps_too(method, exact):
    solution = solve(method, Control(1e-9, 1e-10))
    assert jnp.allclose(solution.ys["q"], exact, rtol=0, atol=1e-8)


def test_the_unrolled_method_takes_the_steps_of_diffrax(exact):
    control = dfx.PIDController(rtol=1e-6, atol=1e-8)
    own, stock = solve(Tsit5(), control), solve(dfx.Tsit5(), control)
    assert own.stats["num_steps"] == stock.stats["num_steps"]
    # sums in another order, to which step sizes answer by another rounding
    assert jnp.allclose(own.ys["q"], stock.ys["q"], rtol=0, atol=1e-12)


def test_rodas4_damps_what_is_infinitely_fast():
    """L-stable: the slow solution is kept in steps of 0.1 s beside eigenvalues of 1e8 1/s."""

    def field(t, y):
        return {"fast": -1e8 * (y["fast"] - jnp.cos(t)) - jnp.sin(t), "slow": -y["slow"]}

    start = {"fast": jnp.array(3.0), "slow": jnp.array(1.0)}
    end = repeat(Rodas4(), field, jnp.array(0.0), start, jnp.array(0.1), 10)
    assert jnp.isclose(end["fast"], jnp.cos(1.0), rtol=0, atol=1e-6)
    assert jnp.isclose(end["slow"], jnp.exp(-1.0), rtol=0, atol=1e-6)
    explicit = repeat(RungeKutta4(), field, jnp.array(0.0), start, jnp.array(0.1), 10)
    assert not jnp.abs(explicit["fast"]) < 1e6


@pytest.mark.stress(39)
def test_semi_implicit_euler_keeps_energy_where_explicit_euler_gains():
    def spring(t, y):
        return {"q": y["v"], "v": -y["q"]}

    start = {"q": jnp.array(1.0), "v": jnp.array(0.0)}
    end = repeat(SemiImplicitEuler(), spring, jnp.array(0.0), start, jnp.array(0.1), 10_000)
    assert abs(float(end["q"] ** 2 + end["v"] ** 2) - 1) < 0.11
    assert (1 + 0.1**2) ** 10_000 > 1e40  # by explicit Euler
    with pytest.raises(ValueError, match="no leaf of the state"):
        repeat(
            SemiImplicitEuler(),
            lambda t, y: -y,
            jnp.array(0.0),
            1.0 * jnp.ones(2),
            jnp.array(0.1),
            1,
        )


def test_tolerances_may_differ_between_components():
    loose = {"q": jnp.array(1e-3), "v": jnp.array(1e-3)}
    tight = {"q": jnp.array(1e-9), "v": jnp.array(1e-3)}
    rtol = {"q": jnp.array(0.0), "v": jnp.array(0.0)}
    few, many = (solve(Tsit5(), Control(rtol, atol)) for atol in (loose, tight))
    assert int(few.stats["num_steps"]) < int(many.stats["num_steps"])
    with pytest.raises(ValueError, match="one number per leaf"):
        solve(Tsit5(), Control({"q": 1e-3}, 1e-6))


def test_forward_and_reverse_derivatives_agree(exact):
    def end(scale, adjoint):
        start = jax.tree.map(lambda x: scale * x, START)
        return solve(Rodas4(), Control(1e-9, 1e-10), start, adjoint).ys["q"][-1, 0]

    one = jnp.array(1.0)
    reverse = jax.grad(end)(one, None)
    forward = jax.jacfwd(end)(one, dfx.ForwardMode())
    h = 1e-3
    difference = (end(one + h, None) - end(one - h, None)) / (2 * h)
    assert jnp.isclose(reverse, forward, rtol=1e-12)
    assert jnp.isclose(reverse, difference, rtol=1e-6)


def edge(t, y):
    """Not finite beyond y = 1, which exp(t) reaches at the end and steps beyond."""
    return {"y": jnp.where(y["y"] < 1.0, y["y"], jnp.nan) + 0 * jnp.sqrt(1.0 - y["y"])}


@pytest.mark.stress(46)
def test_a_step_into_nan_is_repeated_and_leaves_no_nan_in_gradients():
    def last(start):
        solution = solve(Tsit5(), Control(1e-4, 1e-4), {"y": start}, field=edge, end=0.999)
        return solution.ys["y"][-1], solution.stats["num_rejected_steps"]

    (value, rejected), slope = jax.value_and_grad(last, has_aux=True)(jnp.exp(-1.0))
    assert int(rejected) > 0 and jnp.isfinite(value)
    assert jnp.isclose(slope, jnp.exp(0.999), rtol=1e-3)


@pytest.mark.stress(46)
def test_a_run_that_cannot_go_on_ends_soon_at_its_last_good_state():
    solution = solve(Tsit5(), Control(), {"y": jnp.exp(-1.0)}, field=edge, end=2.0)
    assert solution.result == dfx.RESULTS.dt_min_reached
    assert int(solution.stats["num_steps"]) < 150


# Generalised-alpha


@pytest.mark.parametrize("rho", [0.0, 0.5, 1.0])
def test_what_is_infinitely_fast_keeps_rho_inf_of_its_size_in_a_step(rho):
    """A swing of 1e6 rad/s in steps of 1 s, from its second step on."""

    def swing(t, y):
        return {"q": y["v"], "v": -1e12 * y["q"]}

    start = {"q": jnp.array(0.0), "v": jnp.array(1.0)}
    sizes, one = [], jnp.array(1.0)
    step = jax.jit(lambda y, m: repeated(GeneralisedAlpha(rho), swing, 0 * one, y, one, 1, m))
    y, memory = start, swing(0.0, start)
    for _ in range(12):
        y, memory, converged = step(y, memory)
        sizes.append(float(jnp.hypot(1e6 * y["q"], y["v"])))
        assert converged
    if rho == 0.0:
        assert sizes[-1] < 1e-6 * sizes[0]
    else:
        assert np.isclose((sizes[-1] / sizes[3]) ** (1 / 8), rho, rtol=0.15)


def stiffening(t, y):
    """A spring whose force grows without bounds towards |q| = 1, not finite beyond."""
    return {"q": y["v"], "v": -1e3 * jnp.arctanh(y["q"])}


def test_a_step_that_does_not_converge_is_cut_and_never_accepted():
    start = {"q": jnp.array(0.0), "v": jnp.array(40.0)}
    zero, h = jnp.array(0.0), jnp.array(0.2)

    def end(scale, method, count=1):
        first = jax.tree.map(lambda x: scale * x, start)
        return repeated(method, stiffening, zero, first, h / count, count)

    one = jnp.array(1.0)
    (held, _, converged) = end(one, GeneralisedAlpha(max_cuts=0))
    assert not converged and held == start
    y, _, converged = end(one, GeneralisedAlpha())
    exact = end(one, GeneralisedAlpha(), 2000)[0]
    assert converged and jnp.abs(y["q"]) < 1
    energy = [40.0**2 / 2, float(y["v"] ** 2 / 2 + 1e3 * _stored(y["q"]))]
    assert energy[1] < 1.05 * energy[0]
    total = float(exact["v"] ** 2 / 2 + 1e3 * _stored(exact["q"]))
    assert np.isclose(total, energy[0], rtol=5e-3)
    slope = jax.grad(lambda s: end(s, GeneralisedAlpha())[0]["q"])(one)
    forward = jax.jacfwd(lambda s: end(s, GeneralisedAlpha())[0]["q"])(one)
    step = 1e-6
    ends = [end(one + d, GeneralisedAlpha())[0]["q"] for d in (step, -step)]
    assert jnp.isclose(slope, forward, rtol=1e-9)
    assert jnp.isclose(slope, (ends[0] - ends[1]) / (2 * step), rtol=1e-5)


def _stored(q):
    """The integral of arctanh."""
    return q * jnp.arctanh(q) + jnp.log1p(-(q**2)) / 2


def _implicit(size, x, rate):
    """x after a step of the implicit Euler method for x' = -rate x^2, in closed form."""
    return (jnp.sqrt(1 + 4 * size * rate * x) - 1) / (2 * size * rate)


@jax.custom_jvp
def _at(size, x, rate, found):
    return found


@_at.defjvp
def _at_jvp(primals, tangents):
    size, x, rate, y = primals
    dsize, dx, drate, _ = tangents
    slope = 1 + 2 * size * rate * y  # of y + size rate y^2 - x = 0
    return y, (dx - y**2 * (dsize * rate + size * drate)) / slope


LONGEST = 0.3  # at x = 1 the longest step that converges; longer ones the smaller x is


def _searched(given, offset, size, x):
    return _implicit(size, x, given), size * x <= LONGEST


def _taken(given, offset, size, x, found):
    return _at(size, x, given, found)


def _plain(given, offset, size, x):
    return _implicit(size, x, given), size * x <= LONGEST


@pytest.mark.parametrize("attempt", [_plain, SearchedAttempt(_searched, _taken)])
def test_derivatives_of_a_step_in_parts_are_those_of_the_parts(attempt):
    """Lanes of a batch are cut differently: whole, in halves and in quarters, and held."""
    start, steps = jnp.array([0.25, 0.5, 0.9, 1e6]), jnp.array([1, 2, 4, 0])

    def after(x, h, rate):
        return cut(attempt, 8, rate, h, x)

    def expected(count, x, h, rate):
        for _ in range(count):
            x = _implicit(h / count, x, rate)
        return x

    h, rate = jnp.array(1.0), jnp.array(0.7)
    values, reached = jax.vmap(lambda x: after(x, h, rate))(start)
    assert jnp.array_equal(reached, steps > 0)
    for slopes in (jax.jacfwd, jax.jacrev):
        one = slopes(after, (0, 1, 2), has_aux=True)
        found = jax.vmap(one, (0, None, None))(start, h, rate)[0]
        for k, rows in enumerate(zip(*found, strict=True)):
            if steps[k] == 0:
                assert values[k] == start[k]
                continue
            count = int(steps[k])
            assert np.isclose(values[k], expected(count, start[k], h, rate), rtol=1e-13)
            wanted = jax.grad(expected, (1, 2, 3))(count, start[k], h, rate)
            assert np.allclose(rows, wanted, rtol=1e-11)


def test_generalised_alpha_is_a_solver_of_diffrax(exact):
    def run(method):
        return dfx.diffeqsolve(
            dfx.ODETerm(lambda t, y, args: swing(t, y)),
            method,
            0.0,
            1.0,
            0.01,
            START,
            throw=False,
        )

    solution = run(GeneralisedAlpha())
    assert solution.result == dfx.RESULTS.successful
    assert jnp.allclose(solution.ys["q"][-1], exact[-1], rtol=0, atol=1e-4)
    failed = run(GeneralisedAlpha(max_iterations=0))
    assert failed.result == dfx.RESULTS.nonlinear_divergence
