"""Runs of systems: events, batches, rates of sampling, going on from a file."""

import subprocess
import sys
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import _progress, io, systems as S
from sorojax._types import from_host, real
from sorojax.math.status import Status
from sorojax.systems.integrate import integrate

ROOT = Path(__file__).parent.parent


class Ball(S.AbstractBlock):
    """A ball that falls."""

    height: jax.Array = eqx.field(converter=real, default=1.0)

    @property
    def inputs(self):
        return {}

    @property
    def outputs(self):
        return {"height": S.Output("m")}

    def initial_state(self):
        return {"q": self.height, "v": jnp.zeros_like(self.height)}

    def output(self, name, t, state, inputs):
        return state["q"]

    def vector_field(self, t, state, inputs):
        return {"q": state["v"], "v": jnp.full_like(state["q"], -9.81)}


class Growth(S.AbstractBlock):
    """y' = rate (y^2 - y): above one it blows up, below it decays."""

    start: jax.Array = eqx.field(converter=real)
    rate: jax.Array = eqx.field(converter=real, default=1.0)

    @property
    def inputs(self):
        return {"push": S.Input("1/s", (), 0.0)}

    @property
    def outputs(self):
        return {"y": S.Output(None)}

    def initial_state(self):
        return {"y": self.start}

    def output(self, name, t, state, inputs):
        return state["y"]

    def vector_field(self, t, state, inputs):
        return {"y": self.rate * (state["y"] ** 2 - state["y"]) + inputs["push"]}


def growth(start):
    return S.Network({"g": Growth(start)}, {})


def bounce(t, state):
    ball = state["ball"]
    return {"ball": {"q": jnp.zeros_like(ball["q"]), "v": -0.5 * ball["v"]}}


FALLS = np.sqrt(2 / 9.81)  # s to the ground from 1 m
BOUNCE = S.Event("ball.height", bounce, rising=False)


@pytest.fixture(scope="module")
def bounced():
    return S.simulate(
        S.Network({"ball": Ball()}, {}), 1.2, save=25, events=(BOUNCE,), max_events=4
    )


# Events


def test_a_ball_bounces_when_and_how_it_should(bounced):
    hits = FALLS * np.array([1.0, 2.0, 2.5])  # half the speed: half the time in the air
    assert bounced.status == Status.successful and bounced.happened.count == 3
    assert jnp.allclose(bounced.happened.time[:3], hits, rtol=0, atol=1e-7)
    t = np.asarray(bounced.time)
    speed = 9.81 * FALLS / 2
    first = 1 - 9.81 / 2 * t**2
    second = speed * (t - hits[0]) - 9.81 / 2 * (t - hits[0]) ** 2
    third = speed / 2 * (t - hits[1]) - 9.81 / 2 * (t - hits[1]) ** 2
    last = speed / 4 * (t - hits[2]) - 9.81 / 2 * (t - hits[2]) ** 2
    want = np.select([t < hits[0], t < hits[1], t < hits[2]], [first, second, third], last)
    assert jnp.allclose(bounced["ball.height"], want, rtol=0, atol=1e-6)


def test_a_terminating_event_holds_the_state_and_has_the_exact_gradient():
    def landing(height):
        network = S.Network({"ball": Ball(height)}, {})
        film = S.simulate(
            network,
            1.0,
            save=3,
            events=(S.Event("ball.height"),),
            max_events=1,
            adjoint=dfx.ForwardMode(),
        )
        return film.stats["reached"], film

    slope, film = jax.jacfwd(landing, has_aux=True)(jnp.array(1.0))
    assert film.status == Status.successful and film.happened.count == 1
    assert jnp.isclose(film.stats["reached"], FALLS, rtol=0, atol=1e-8)
    assert jnp.isclose(film["ball.height"][-1], 0.0, atol=1e-8)
    assert jnp.isclose(slope, FALLS / 2, rtol=1e-6)


@pytest.mark.stress(48)
def test_several_events_tell_which_of_them_happened():
    half = S.Event(lambda t, state, block, inputs: state["ball"]["q"] - 0.5, lambda t, s: s)
    network = S.Network({"ball": Ball()}, {})
    film = S.simulate(network, 0.6, save=3, events=(BOUNCE, half), max_events=3, max_step=0.1)
    assert film.happened.which[:2].tolist() == [1, 0]
    hits = jnp.array([np.sqrt(1 / 9.81), FALLS])
    assert jnp.allclose(film.happened.time[:2], hits, rtol=0, atol=1e-8)


@pytest.mark.stress(49)
def test_events_without_end_are_cut_off():
    network = S.Network({"ball": Ball()}, {})
    film = S.simulate(network, 3.0, save=3, events=(BOUNCE,), max_events=4, throw=False)
    assert film.status == Status.max_events and film.happened.count == 5


# Batches


@pytest.fixture(scope="module")
def batch():
    starts = jnp.array([0.1, 0.5, 0.9, 3.0])

    def cost(starts):
        film = S.simulate_batch(growth, starts, 2.0, save=5)
        return jnp.sum(film["g.y"][:, -1]), film

    slopes, film = jax.grad(cost, has_aux=True)(starts)
    return starts, film, slopes


@pytest.mark.stress(45)
def test_a_member_that_diverges_is_held_and_leaves_the_others_alone(batch):
    starts, film, slopes = batch
    good = np.asarray(starts[:3])
    decayed = 1 / (1 + (1 / good - 1) * np.exp(2.0))
    assert (film.status == Status.successful).tolist() == [True, True, True, False]
    assert jnp.allclose(film["g.y"][:3, -1], decayed, rtol=1e-6)
    slope = np.exp(2.0) / (good + (1 - good) * np.exp(2.0)) ** 2
    assert jnp.allclose(slopes[:3], slope, rtol=1e-5) and slopes[3] == 0.0
    blow_up = np.log(1.5)  # where 3 grows beyond all bounds
    assert 0.99 * blow_up < film.stats["reached"][3] < 1.0001 * blow_up
    assert film["g.y"][3, -1] > 1e3 and jnp.all(jnp.isfinite(film["g.y"]))
    assert jnp.all(film.stats["steps"] < 1000)


def test_members_equal_their_runs_alone(batch):
    starts, film, _ = batch
    alone = S.simulate(growth(starts[1]), 2.0, save=5)
    assert jnp.allclose(film["g.y"][1], alone["g.y"], rtol=1e-12)
    assert film.stats["steps"][1] == alone.stats["steps"]


def test_a_run_that_fails_says_where_and_holds():
    film = S.simulate(growth(3.0), 2.0, save=5, throw=False)
    assert film.status == Status.not_finite and jnp.all(jnp.isfinite(film["g.y"]))
    fixed = S.simulate(growth(3.0), 2.0, save=5, step=0.1, throw=False)
    assert fixed.status == Status.not_finite and float(fixed.stats["reached"]) == 0.6
    assert jnp.all(jnp.isfinite(fixed["g.y"]))
    with pytest.raises(RuntimeError, match="stopped after 0.4"):
        S.simulate(growth(3.0), 2.0, save=5)


def test_batches_refuse_what_does_not_fit():
    with pytest.raises(ValueError, match="one axis of members"):
        S.simulate_batch(growth, jnp.array(1.0), 1.0)


DEVICES = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
from sorojax import systems as S
from sorojax.math.status import Status
from tests.test_systems_runs import growth
starts = jnp.array([0.1, 3.0, 0.5, 0.9])
whole = S.simulate_batch(growth, starts, 2.0, save=3)
split = S.simulate_batch(growth, starts, 2.0, save=3, devices=jax.devices())
assert len(jax.devices()) == 2
good = whole.status == Status.successful
assert good.tolist() == [True, False, True, True]
assert jnp.allclose(whole["g.y"][good], split["g.y"][good], rtol=1e-9)
assert jnp.array_equal(whole.stats["steps"][0], split.stats["steps"][0])
assert (whole.status == split.status).all()
"""


@pytest.mark.slow
def test_a_batch_is_shared_among_devices():
    run(DEVICES, XLA_FLAGS="--xla_force_host_platform_device_count=2")


ENVIRONMENTS = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
from sorojax import envs
env = envs.FingerReach()
params, key = env.default_params(), jax.random.key(0)
states, _ = jax.vmap(lambda key: envs.reset(env, key, params))(jax.random.split(key, 4))
actions = jax.random.uniform(key, (4, env.num_actions), minval=-1.0)
step = jax.vmap(lambda state, action: envs.step(env, key, state, action, params))
apart = jax.P("members")
mesh = jax.sharding.Mesh(np.array(jax.devices()), ("members",))
split = jax.shard_map(step, mesh=mesh, in_specs=apart, out_specs=apart, check_vma=False)
alone, both = jax.jit(step)(states, actions), jax.jit(split)(states, actions)
assert len(both.reward.sharding.device_set) == 2
assert jnp.allclose(alone.observation, both.observation, rtol=0, atol=1e-9)
"""


@pytest.mark.slow
def test_environments_are_shared_among_devices():
    run(ENVIRONMENTS, XLA_FLAGS="--xla_force_host_platform_device_count=2")


# Sampling


class Counter(eqx.Module):
    """Commands how often it has been called."""

    def start(self, t, measurement):
        return jnp.zeros_like(measurement)

    def __call__(self, t, measurement, memory):
        return memory + 1, memory + 1


PLANT = S.Network({"slow": Growth(0.5), "fast": Growth(0.5)}, {}, ("slow.push", "fast.push"))
RATES = (
    S.Sampled(Counter(), "slow.y", "slow.push", every=5),
    S.Sampled(Counter(), "fast.y", "fast.push", every=2),
)


def test_controllers_run_at_their_own_rates():
    film = S.simulate_sampled(PLANT, RATES, 0.1, period=0.01, substeps=1)
    ticks = np.arange(11)
    assert jnp.array_equal(film["slow.push"], ticks // 5 + 1.0)
    assert jnp.array_equal(film["fast.push"], ticks // 2 + 1.0)
    assert film.stats["calls"] == 3 + 6


@pytest.mark.stress(50)
def test_no_tick_is_lost_in_a_long_run():
    film = S.simulate_sampled(
        PLANT, RATES[:1], 20.0, period=1e-3, substeps=1, inputs={"fast.push": 0.0}
    )
    assert film["slow.push"][-1] == 4001 and jnp.isclose(film.time[-1], 20.0, rtol=1e-15)


# Going on

HALVES = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
from sorojax import _progress, io, systems as S
from tests.test_systems_runs import PLANT, RATES, growth
folder = {folder!r}
sampled = lambda **k: S.simulate_sampled(PLANT, RATES, 0.2, period=0.01, substeps=2, **k)
fixed = lambda **k: S.simulate(growth(0.5), 0.5, save=11, step=0.01, **k)
adaptive = lambda **k: S.simulate(
    growth(0.5), 0.5, save=6, rtol=1e-5, solver=S.{solver}(), **k
)
runs = {{"a": sampled, "b": fixed, "c": adaptive}}
for name, run in runs.items():
    if {save}:
        io.save(f"{{folder}}/{{name}}.npz", run())
    else:
        like = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(run))
        first = io.load(f"{{folder}}/{{name}}.npz", like)
        io.save(f"{{folder}}/{{name}}2.npz", run(resume=first))
"""


@pytest.mark.parametrize("solver", ["Tsit5", pytest.param("Rodas4", marks=pytest.mark.slow)])
def test_two_halves_in_two_processes_give_the_bits_of_the_whole(tmp_path, solver):
    """Also adaptively: the second half takes the steps that the whole run takes."""
    for save in (True, False):
        run(HALVES.format(folder=str(tmp_path), save=save, solver=solver))
    method = getattr(S, solver)()
    whole = {
        "a2": S.simulate_sampled(PLANT, RATES, 0.4, period=0.01, substeps=2),
        "b2": S.simulate(growth(0.5), 1.0, save=21, step=0.01),
        "c2": S.simulate(growth(0.5), 1.0, save=11, rtol=1e-5, solver=method),
    }
    for name, film in whole.items():
        half = load_like(tmp_path / f"{name}.npz", _half(film))
        for x, y in zip(*map(_series, (film, half)), strict=True):
            assert jnp.array_equal(x[-len(y) :], y)
        assert jax.tree.all(jax.tree.map(jnp.array_equal, film.memory, half.memory))


def _series(film):
    return jax.tree.leaves((film.time, film.state, film.outputs))


def _half(film):
    """The shapes of the second half of a motion."""
    count = film.time.shape[0] // 2 + 1
    shapes = eqx.filter_eval_shape(lambda f=film: f)

    def cut(x):
        return jax.ShapeDtypeStruct((count, *x.shape[1:]), x.dtype)

    parts = jax.tree.map(cut, (shapes.time, shapes.state, shapes.outputs))
    return eqx.tree_at(lambda f: (f.time, f.state, f.outputs), shapes, parts)


@pytest.mark.parametrize(
    "go",
    [
        lambda **k: S.simulate(growth(0.5), 0.5, save=6, **k),
        lambda **k: S.simulate(growth(0.5), 0.5, save=6, step=0.01, **k),
        lambda **k: S.simulate_sampled(PLANT, RATES, 0.2, period=0.01, substeps=2, **k),
    ],
    ids=["adaptive", "fixed", "sampled"],
)
def test_progress_is_told_and_changes_nothing(go):
    told = []
    with _progress.listen(lambda p: told.append((p.label, p.done))):
        film = go(progress=True)
        jax.effects_barrier()
    shares = [share for label, share in told if label == "simulate"]
    assert len(shares) >= 3 and np.all(np.diff(shares) >= 0)
    assert np.isclose(shares[-1], 1.0) and shares[0] < 0.7
    plain = go()
    assert all(jnp.array_equal(x, plain[name]) for name, x in film.outputs.items())


def load_like(path, shapes):
    blank = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype) if hasattr(x, "shape") else x, shapes
    )
    return io.load(path, blank)


@pytest.mark.stress(33)
def test_damaged_files_are_refused(tmp_path):
    tree = {"a": jnp.arange(3.0), "key": jax.random.key(3), "name": "x"}
    file = tmp_path / "s.npz"
    io.save(file, tree)
    back = io.load(file, {**tree, "a": jnp.zeros(3)})
    assert jnp.array_equal(back["a"], tree["a"]) and back["name"] == "x"
    assert jnp.array_equal(jax.random.key_data(back["key"]), jax.random.key_data(tree["key"]))
    with pytest.raises(ValueError, match="structure that was saved"):
        io.load(file, {"a": jnp.zeros(3)})
    content = bytearray(file.read_bytes())
    at = content.index(np.arange(3.0).tobytes())
    content[at + 9] ^= 1
    file.write_bytes(content)
    with pytest.raises(ValueError, match="damaged"):
        io.load(file, tree)
    file.write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(ValueError, match="damaged"):
        io.load(file, tree)


def run(script, **environment):
    import os

    flags = os.environ.get("XLA_FLAGS", "")
    extra = environment.pop("XLA_FLAGS", "")
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env={**os.environ, "XLA_FLAGS": f"{flags} {extra}".strip()},
    )
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.mark.stress(93)
@pytest.mark.parametrize("options", [{"rtol": 1e-9}, {"step": 0.05}])
def test_a_run_that_goes_on_has_the_slope_of_the_first_half(options):
    def vessel(start):
        return S.Network({"air": S.Reservoir(start, volume=1e-4, leakage=0.5)}, {})

    def end(start):
        first = S.simulate(vessel(start), 1.0, save=5, solver=S.Tsit5(), **options)
        later = S.simulate(vessel(1e4), 1.0, save=5, solver=S.Tsit5(), resume=first, **options)
        return later["air.pressure"][-1]

    assert jnp.isclose(jax.grad(end)(jnp.asarray(5e4)), jnp.exp(-1.0), rtol=1e-6)


def test_gradient_by_the_noted_steps_is_that_of_a_run_again(monkeypatch):
    def end(start, most):
        vessel = S.Network({"air": S.Reservoir(start, volume=1e-4, leakage=0.5)}, {})
        run = S.simulate(vessel, 1.0, save=5, solver=S.Rodas4(), max_steps=most)
        return run["air.pressure"][-1]

    noted = jax.grad(end)(jnp.asarray(5e4), 1000)
    monkeypatch.setattr(integrate, "_room", lambda *_: 0)
    again = jax.grad(end)(jnp.asarray(5e4), 1001)
    assert jnp.isclose(noted, again, rtol=1e-12)
    assert jnp.isclose(noted, jnp.exp(-0.5), rtol=1e-5)


def test_arrays_of_numpy_are_copied():
    given = np.arange(40.0)
    made = from_host(given)
    given[:] = 0.0
    assert made[-1] == 39.0 and made.dtype == given.dtype
