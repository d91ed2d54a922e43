"""Environments: members that end alone, gradients, the shapes of Gymnasium and of Brax."""

import functools
import subprocess
import sys
import warnings

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from sorojax import envs, io
from sorojax.envs.core import BOUND
from sorojax.envs.supply_line import LATE_STEPS, begun, sent
from sorojax.envs.tasks import finger, solid_crawler

pytestmark = pytest.mark.quick

REACH = envs.FingerReach(time_step=4e-3, substeps=5, max_steps=3)
PUSH = envs.TentaclePush(time_step=2e-3, substeps=5, max_steps=60)
TRACK = envs.TipTracking(time_step=4e-3, substeps=5, max_steps=100)
CRAWL = envs.CrawlerRun(time_step=1e-3, substeps=10, max_steps=100)
BALL, PICK = envs.BallTurn(), envs.PickPlace()
TASKS = [
    pytest.param(env, id=type(env).__name__) for env in (REACH, PUSH, TRACK, CRAWL, BALL, PICK)
]
MEMBERS = 4


def small_body():
    return envs.solid_finger(4e-3, modes=6, tolerance=0.01)


@functools.cache
def small_crawler():
    """Trained on the first tenth of a second of a gait alone."""
    time = 2e-3 * np.arange(51)
    waves = np.maximum(np.sin(15 * time[None] - np.arange(2)[:, None]), 0.0)
    command = jnp.asarray(solid_crawler.MAX_PRESSURE * waves)
    return solid_crawler.trained_on(solid_crawler.full_crawler(), [command], 6, 0.05)


SOLIDS = {"SolidReach": small_body, "SolidCrawl": small_crawler}  # trained where they are used
TASKS += [pytest.param("SolidReach", id="SolidReach")]
TASKS += [pytest.param("SolidCrawl", id="SolidCrawl", marks=pytest.mark.slow)]


@pytest.fixture
def env(request):
    if request.param == "SolidReach":
        return envs.SolidReach(max_steps=3, body=small_body())
    if request.param == "SolidCrawl":
        return envs.SolidCrawl(max_steps=100, substeps=2, body=small_crawler())
    return request.param


@eqx.filter_jit
def started(env, keys, params):
    return jax.vmap(lambda k: envs.reset(env, k, params))(keys)


@eqx.filter_jit
def stepped(env, keys, states, actions, params):
    return jax.vmap(lambda *one: envs.step(env, *one))(keys, states, actions, params)


@eqx.filter_jit
def stepped_on(env, keys, states, actions, params):
    return jax.vmap(lambda *one: envs.step_with_reset(env, *one))(keys, states, actions, params)


def members(env, key, spread=0.1):
    """Keys, states, actions and parameters of a batch."""
    params = env.default_params()
    keys = jax.random.split(key, MEMBERS)
    states, observations = started(env, keys, params)
    actions = jax.random.uniform(key, (MEMBERS, env.num_actions), minval=-1.0)
    many = envs.randomised(params, key, spread, members=MEMBERS)
    return (keys, states, actions, many), observations


def same_bits(one, other):
    return all(
        np.array_equal(np.asarray(a), np.asarray(b))
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    )


def spoilt(states, k):
    """The states, with rates of member `k` that no physics can go on from."""
    return eqx.tree_at(lambda s: s.body.v, states, states.body.v.at[k].set(1e200))


@pytest.mark.versions
@pytest.mark.parametrize("env", TASKS, indirect=True)
def test_a_member_of_a_batch_with_its_own_numbers_is_what_it_is_alone(env, getkey):
    given, observations = members(env, getkey())
    assert observations.shape == (MEMBERS, env.num_observations)
    together = stepped(env, *given)
    for k in (0, MEMBERS - 1):
        own = jax.tree.map(lambda x, k=k: x[k : k + 1], given)
        alone = stepped(env, *own)
        for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True):
            np.testing.assert_allclose(a[0], b[k], rtol=1e-9, atol=1e-12)  # order of sums
    assert np.ptp(together.reward) > 0 and not together.info["diverged"].any()
    assert (np.abs(together.observation) <= BOUND).all()


@pytest.mark.parametrize("env", TASKS, indirect=True)
def test_a_member_that_diverges_ends_alone_and_changes_no_bit(env, getkey):
    (keys, states, actions, params), _ = members(env, getkey())
    sound = stepped(env, keys, states, actions, params)
    broken = stepped(env, keys, spoilt(states, 2), actions, params)
    others = np.array([0, 1, 3])
    assert same_bits(*(jax.tree.map(lambda x: x[others], x) for x in (sound, broken)))
    assert broken.info["diverged"].tolist() == [False, False, True, False]
    assert broken.terminated.tolist() == [False, False, True, False]
    assert np.isfinite(broken.observation).all() and np.isfinite(broken.reward).all()
    assert np.array_equal(broken.state.body.q[2], states.body.q[2])

    after = stepped_on(env, keys, spoilt(states, 2), actions, params)
    assert after.state.steps.tolist() == [1, 1, 0, 1]
    assert (np.asarray(after.state.body.v[2]) == 0).all()
    assert np.isfinite(after.observation).all()


@pytest.mark.parametrize("env", TASKS, indirect=True)
def test_a_member_that_diverges_leaves_the_gradient_of_the_others(env, getkey):
    (keys, states, actions, params), _ = members(env, getkey())

    @jax.jit
    def slopes(gains, scale, states):
        """By a number of each member, and by one that all share."""

        def total(gains, scale):
            act = actions * gains[:, None] * scale
            each = jax.vmap(lambda *given: envs.step(env, *given).reward)
            return jnp.sum(each(keys, states, act, params))

        return jax.grad(total, argnums=(0, 1))(gains, scale)

    given = jnp.full(MEMBERS, 0.3), jnp.asarray(1.0)
    own, shared = slopes(*given, states)
    left, shared_left = slopes(*given, spoilt(states, 2))
    kept = np.array([0, 1, 3])
    assert same_bits(own[kept], left[kept]) and (own[kept] != 0).all()
    assert np.isfinite(left[2])
    assert float(shared_left) == pytest.approx(float(left @ given[0]), rel=1e-9)
    assert float(shared) == pytest.approx(float(own @ given[0]), rel=1e-9)


@pytest.mark.parametrize("env", TASKS, indirect=True)
def test_same_key_same_result(env, getkey):
    given, observations = members(env, getkey())
    keys, params = given[0], env.default_params()
    assert same_bits(started(env, keys, params)[1], observations)
    assert same_bits(stepped(env, *given), stepped(env, *given))
    other = started(env, keys[::-1], params)[1]
    assert not np.array_equal(other, observations)


@pytest.mark.parametrize("env", TASKS, indirect=True)
def test_stored_states_and_numbers_go_on_to_the_same_bits(env, tmp_path, getkey):
    keys, states, actions, params = members(env, getkey())[0]
    io.save(tmp_path / "batch.npz", (env, states, params))
    again, states_again, params_again = io.load(tmp_path / "batch.npz")
    assert again == env
    want = stepped(env, keys, states, actions, params)
    assert same_bits(stepped(again, keys, states_again, actions, params_again), want)


def test_the_pressures_of_the_goal_hold_the_tip_there(getkey):
    (keys, states, _, _), _ = members(REACH, getkey())
    params = REACH.default_params()
    actions = 2 * states.goal.pressure / params.max_pressure - 1
    many = envs.randomised(params, getkey(), 0.0, members=MEMBERS)
    for _ in range(120):
        after = stepped(REACH, keys, states, actions, many)
        states = after.state
    assert (after.info["distance"] < 1e-8).all() and after.info["success"].all()  # m
    assert after.truncated.all() and not after.terminated.any()


def test_a_tentacle_that_is_pushed_at_a_post_bends_round_it_and_stays_outside(getkey):
    (keys, states, actions, _), _ = members(PUSH, getkey())
    params = envs.randomised(PUSH.default_params(), getkey(), 0.0, members=MEMBERS)
    aside = jnp.asarray([0.3e-3, -0.3e-3, 2e-3, 30e-3])  # m, of the first post from the axis
    states = eqx.tree_at(
        lambda s: s.goal.posts, states, states.goal.posts.at[:, 0, 1].set(aside)
    )
    states = eqx.tree_at(
        lambda s: s.goal.posts, states, states.goal.posts.at[:, 1:, 1].set(0.2)
    )
    push = jnp.zeros_like(actions).at[:, 0].set(1.0)
    for _ in range(60):
        after = stepped(PUSH, keys, states, push, params)
        states = after.state
    tip = np.asarray(jax.vmap(PUSH.markers)(states.body, params)[:, -1])
    assert not after.info["diverged"].any()
    assert tip[0, 1] < -7e-3 and tip[1, 1] > 7e-3 and tip[2, 1] < -7e-3  # beside a post of 8
    assert abs(tip[3, 1]) < 1e-6 and tip[3, 0] > 0.29  # that of nothing in its way
    assert (tip[:3, 0] < tip[3, 0]).all()


def test_a_post_that_is_passed_through_ends_the_episode(getkey):
    (keys, states, actions, _), _ = members(PUSH, getkey())
    inside = states.goal.posts.at[1, 0].set(jnp.asarray([0.15, 0.0]))
    states = eqx.tree_at(lambda s: s.goal.posts, states, inside)
    params = envs.randomised(PUSH.default_params(), getkey(), 0.0, members=MEMBERS)
    after = stepped(PUSH, keys, states, 0 * actions, params)
    assert after.info["diverged"].tolist() == [False, True, False, False]


def test_a_reference_stays_where_the_finger_can_rest(getkey):
    """The reach is less than that of two chambers in their weakest direction, at 30 degrees."""
    (_, states, _, _), observed = members(TRACK, getkey())
    params, goal = TRACK.default_params(), states.goal
    steps = jnp.arange(TRACK.max_steps + 1)
    path = jax.vmap(lambda goal: TRACK.reference(goal, steps))(goal)
    radius = np.linalg.norm(path, axis=-1)
    assert (radius[:, 0] == 0).all() and (radius[:, 25:].max(axis=1) > 0.1 * goal.reach).all()
    assert (radius.max(axis=1) <= goal.reach).all()
    weakest = params.max_pressure * jnp.asarray([1.0, 0.5, 0.0])
    most = np.linalg.norm(jax.jit(finger.tip_at_rest)(weakest, params)[1:])
    assert (goal.reach < most).all() and (goal.reach > 0.8 * most).all()
    ahead = (path[:, 1] - path[:, 0]) / params.length
    np.testing.assert_allclose(observed[:, 8:10], ahead, atol=1e-15)


def test_each_episode_of_tracking_has_a_supply_of_its_own(getkey):
    (keys, states, actions, _), _ = members(TRACK, getkey())
    params, line = TRACK.default_params(), states.goal.supply
    for name in ("lag", "dead_time"):
        drawn = np.asarray(getattr(line, name))
        low, high = (float(getattr(x, name)) for x in (params.fastest, params.supply))
        assert (low < drawn).all() and (drawn < high).all() and np.ptp(drawn) > 0
    many = envs.randomised(params, getkey(), 0.0, members=MEMBERS)
    after = stepped(TRACK, keys, states, 0 * actions + 1, many)
    late = np.maximum(TRACK.period - line.dead_time, 0.0)
    want = -np.expm1(-late / line.lag) * params.max_pressure
    np.testing.assert_allclose(after.state.supply.value[:, 0], want, rtol=1e-9)


def test_a_static_inverse_with_a_preview_follows_and_without_one_comes_late(getkey):
    (keys, states, _, _), _ = members(TRACK, getkey())
    params = TRACK.default_params()
    many = envs.randomised(params, getkey(), 0.0, members=MEMBERS)
    shares = np.linspace(0.0, 1.0, 11)
    rest = jax.vmap(lambda p: finger.tip_at_rest(p, params))
    tips = rest(params.max_pressure * jnp.asarray(shares[:, None] * np.array([[1.0, 0, 0]])))
    aside = np.asarray(tips[:, 1])  # of the first chamber, towards -y
    angles = 2 * np.pi * np.arange(3) / 3
    sides = -np.stack([np.cos(angles), np.sin(angles)], axis=1)

    def inverse(wanted):
        far = np.linalg.norm(wanted, axis=1, keepdims=True)
        moment = wanted / np.maximum(far, 1e-9) * np.interp(far, -aside, shares)
        pressure = 2 / 3 * moment @ sides.T
        return 2 * np.clip(pressure - pressure.min(axis=1, keepdims=True), 0, 1) - 1

    reference = jax.jit(jax.vmap(lambda goal, k: TRACK.reference(goal, k[None])[0]))

    def mean_reward(preview):
        now, rewards = states, []
        for _ in range(TRACK.max_steps):
            wanted = reference(now.goal, now.steps + preview)
            after = stepped(TRACK, keys, now, jnp.asarray(inverse(np.asarray(wanted))), many)
            now = after.state
            rewards.append(after.reward)
        return np.mean(rewards)

    steps = jnp.arange(1, TRACK.max_steps + 1)
    path = jax.vmap(lambda goal: TRACK.reference(goal, steps))(states.goal)
    reach = np.asarray(states.goal.reach)
    still = 1 - np.mean(np.linalg.norm(path, axis=-1) / reach[:, None])
    late, early = mean_reward(0), mean_reward(6)
    assert still < late - 0.1 and late < early - 0.05 and early > 0.93


def test_the_order_of_the_chambers_makes_the_way_of_a_crawler(getkey):
    """Half waves from the rear to the front, the other way round, all at once, and no air."""
    (keys, states, _, _), _ = members(CRAWL, getkey())
    level = jnp.zeros(MEMBERS)
    states = eqx.tree_at(lambda s: s.goal.slope, states, level)
    params = envs.randomised(CRAWL.default_params(), getkey(), 0.0, members=MEMBERS)
    lags = np.array([1.0, -1.0, 0.0, 0.0])[:, None] * np.arange(3)
    places = []
    for k in range(150):
        wave = np.sin(2 * np.pi * 2 * k * CRAWL.period - lags)
        share = np.maximum(wave, 0) * np.array([1.0, 1.0, 1.0, 0.0])[:, None]
        after = stepped(CRAWL, keys, states, jnp.asarray(2 * share - 1), params)
        states = after.state
        places.append(np.asarray(states.seen[:, 0, :, 0].mean(axis=1)))
    way = places[-1] - places[49]  # m, of two periods, a second
    assert not after.info["diverged"].any()
    assert way[0] > 10e-3 and way[1] < -10e-3 and abs(way[0] + way[1]) < 0.3 * way[0]
    assert abs(way[2]) < 0.4 * way[0] and abs(way[3]) < 0.2e-3  # noise of the markers


def test_a_crawler_slides_down_where_the_floor_is_steeper_than_its_friction(getkey):
    (keys, states, actions, _), _ = members(CRAWL, getkey())
    params = envs.randomised(CRAWL.default_params(), getkey(), 0.0, members=MEMBERS)
    slopes = jnp.arctan(jnp.asarray([0.5, 0.9, -0.9, 0.0]))
    states = eqx.tree_at(lambda s: s.goal.slope, states, slopes)
    speeds = []
    for _ in range(20):
        after = stepped(CRAWL, keys, states, 0 * actions - 1, params)
        states = after.state
        speeds.append(np.asarray(after.info["velocity"]))
    friction, slip = 0.6, 2e-3  # m/s, below which friction is viscous
    share = 0.5 / friction
    creep = slip * share / np.sqrt(1 - share**2)
    assert speeds[-1][0] == pytest.approx(-creep, rel=1e-3)
    gained = (speeds[-1] - speeds[9]) / (10 * CRAWL.period)
    want = 9.81 * np.cos(slopes[1]) * (0.9 - friction)
    np.testing.assert_allclose(gained[1:], [-want, want, 0], rtol=0.03, atol=1e-6)


@pytest.mark.parametrize("env", TASKS, indirect=True)
def test_the_gradient_through_steps_is_that_of_the_values(env, getkey):
    """Of three steps, in contact where there are posts, by actions and a number of the
    body."""
    state, _ = started(env, getkey()[None], env.default_params())
    state = jax.tree.map(lambda x: x[0], state)
    if env is PUSH:  # the tip leans on a post at once
        posts = state.goal.posts.at[0].set(jnp.asarray([0.2575, 5e-3]))
        state = eqx.tree_at(lambda s: s.goal.posts, state, posts)
    if env is BALL:  # the fingers hold it
        own = jax.tree.map(lambda x: x[None], (state, env.default_params()))
        for k in range(30):
            given = jax.random.key(k)[None], own[0], jnp.ones((1, 6)), own[1]
            own = stepped(env, *given).state, own[1]
        state = jax.tree.map(lambda x: x[0], own[0])
    key = getkey()

    def total(x):
        params = env.default_params()
        # so much that the rounding of a stiff contact is small beside the differences
        factor = 1 + 0.05 * (x[-1] - 0.5)
        number = (
            (lambda p: p.stiffness)
            if isinstance(env, envs.SolidReach | envs.SolidCrawl)
            else (lambda p: p.length)
        )
        params = eqx.tree_at(number, params, number(params) * factor)

        def one(now, _):
            after = envs.step(env, key, now, x[:-1], params)
            return after.state, 100 * after.reward + after.observation[-1]

        return jnp.sum(jax.lax.scan(one, state, None, length=3)[1])

    x = jnp.asarray([0.4, 0.3, 0.2, 0.1, -0.1, -0.2][: env.num_actions] + [0.5])
    # in reverse the contacts of a gripper take minutes to compile
    slope = jax.jit((jax.jacfwd if env is PICK else jax.grad)(total))(x)
    along = jnp.asarray([0.5, 1.0, -0.7, 0.4, 0.9, -0.6][: env.num_actions] + [0.8])
    pushed = jax.jit(lambda x: jax.jvp(total, (x,), (along,)))
    h = 2e-4
    f = [float(pushed(x + k * h * along)[0]) for k in (-2, -1, 1, 2)]
    seen = (8 * (f[2] - f[1]) - (f[3] - f[0])) / (12 * h)
    assert float(slope @ along) == pytest.approx(seen, rel=1e-6)
    assert (np.abs(slope) > 1e-6).all()
    assert float(pushed(x)[1]) == pytest.approx(float(slope @ along), rel=1e-9)


def test_numbers_of_the_robot_make_no_new_program(getkey):
    traces = []

    @jax.jit
    def run(key, state, action, params):
        traces.append(None)
        return envs.step(REACH, key, state, action, params).reward

    given, _ = members(REACH, getkey(), spread=0.2)
    found = [run(*jax.tree.map(lambda x, k=k: x[k], given)) for k in range(2)]
    assert len(traces) == 1 and found[0] != found[1]


def test_a_supply_line_is_a_dead_time_and_a_lag():
    """Against the sum of exponentials of a switch, at a time within a step."""
    line, period = envs.SupplyLine(0.05, 0.03), 0.02
    supplied, commands = begun(jnp.zeros(1)), [1.0, 1.0, -0.5, 2.0, 2.0]
    for k, command in enumerate(commands):
        delivery, supplied = sent(line, supplied, jnp.asarray([command]), period)
        for t in (0.004, 0.013, period):
            now, want, last = k * period + t, 0.0, 0.0
            for j, each in enumerate(commands):
                since = now - 0.03 - j * period
                want += (each - last) * (1 - np.exp(-since / 0.05)) if since > 0 else 0.0
                last = each
            assert float(delivery(jnp.asarray(t))[0]) == pytest.approx(want, abs=1e-14)
    assert float(delivery(jnp.asarray(period))[0]) == float(supplied.value[0])


def test_a_dead_time_that_the_line_cannot_hold_is_refused():
    params = eqx.tree_at(
        lambda p: p.supply.dead_time, REACH.default_params(), jnp.asarray(0.05)
    )
    assert LATE_STEPS * REACH.period < 0.05
    with pytest.raises(ValueError, match=r"FingerReach: `supply.dead_time` must lie in \[0, 0"):
        envs.reset(REACH, jax.random.key(0), params)


def test_an_action_of_another_length_is_refused(getkey):
    (_, states, _, _), _ = members(REACH, getkey())
    state = jax.tree.map(lambda x: x[0], states)
    with pytest.raises(ValueError, match=r"envs.step: `action` has shape \(2,\), need \(3\)"):
        envs.step(REACH, getkey(), state, jnp.zeros(2))


def test_a_spread_may_name_what_varies(getkey):
    params = REACH.default_params()
    spread = jax.tree.map(lambda _: 0.0, params)
    spread = eqx.tree_at(lambda p: p.young_modulus, spread, 0.3)
    many = envs.randomised(params, getkey(), spread, members=50)
    moduli = np.asarray(many.young_modulus / params.young_modulus)
    assert np.exp(-0.3) <= moduli.min() < 0.8 and 1.2 < moduli.max() <= np.exp(0.3)
    assert np.allclose(many.length, params.length, rtol=1e-15)
    assert envs.randomised(params, getkey()).length.shape == ()
    with pytest.raises(ValueError, match="spread"):
        envs.randomised(params, getkey(), -0.1)


# The shapes of others


@pytest.mark.slow
@pytest.mark.parametrize("name", envs.register())
def test_the_checker_of_gymnasium_has_nothing_to_say(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kind = next((kind for kind in SOLIDS if kind in name), None)
        body = {} if kind is None else {"body": SOLIDS[kind]()}
        made = gymnasium.make(name, max_steps=4, render_mode="rgb_array", **body)
        check_env(made.unwrapped)
    made.reset(seed=0)
    ends = [made.step(made.action_space.sample())[2:4] for _ in range(4)]
    assert ends == 3 * [(False, False)] + [(False, True)]


def vector(mode, params=None):
    return envs.to_gymnasium_vector(REACH, MEMBERS, params, autoreset=mode)


def test_a_member_of_a_vector_is_the_environment_of_its_seed():
    many, one = vector("NextStep"), envs.to_gymnasium(REACH)
    seen, _ = many.reset(seed=5)
    alone, _ = one.reset(seed=7)
    np.testing.assert_allclose(seen[2], alone, rtol=1e-6, atol=1e-7)  # single precision
    actions = np.random.default_rng(0).uniform(-1, 1, many.action_space.shape)
    seen, rewards, *_, info = many.step(actions)
    alone, reward, *_, own = one.step(actions[2])
    np.testing.assert_allclose(seen[2], alone, rtol=1e-6, atol=1e-6)
    assert rewards[2] == pytest.approx(reward, rel=1e-9)
    assert info["distance"][2] == pytest.approx(own["distance"], rel=1e-9)
    assert info["_distance"].all() and seen.dtype == np.float32


def test_the_next_step_of_a_member_at_its_end_is_its_reset():
    many = vector("NextStep")
    assert many.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    first, _ = many.reset(seed=0)
    actions = np.ones(many.action_space.shape)
    rows = [many.step(actions) for _ in range(5)]
    assert [row[3].all() for row in rows] == [False, False, True, False, False]
    assert not any(row[2].any() for row in rows)
    assert (rows[3][1] == 0).all() and (rows[4][1] != 0).all()
    assert np.allclose(rows[3][0][:, :6], -1) and not np.allclose(rows[2][0][:, :6], -1)
    assert not np.allclose(rows[3][0], first)  # another goal
    again = vector("NextStep")
    again.reset(seed=0)
    assert all(np.array_equal(again.step(actions)[0], row[0]) for row in rows)


def test_a_member_at_its_end_is_reset_within_the_same_step():
    many, patient = vector("SameStep"), vector("NextStep")
    many.reset(seed=0)
    patient.reset(seed=0)
    actions = np.ones(many.action_space.shape)
    for k in range(3):
        seen, rewards, _, over, info = many.step(actions)
        last, want, *_ = patient.step(actions)
        assert np.array_equal(rewards, want) and over.all() == (k == 2)
        assert ("final_obs" in info) == (k == 2)
    assert info["_final_obs"].all() and np.allclose(seen[:, :6], -1)
    assert np.array_equal(np.stack(info["final_obs"]), last)
    assert info["final_info"]["distance"].shape == (MEMBERS,)
    assert np.array_equal(patient.step(actions)[0], seen)  # the same new episodes


def test_without_autoreset_a_mask_says_who_begins_anew():
    many = vector("Disabled")
    many.reset(seed=0)
    actions = np.ones(many.action_space.shape)
    for _ in range(3):
        last, *_, over, _ = many.step(actions)
    assert over.all()
    with pytest.raises(ValueError, match="4 members are at their end, need none"):
        many.step(actions)
    mask = np.array([True, False, True, False])
    seen, _ = many.reset(options={"reset_mask": mask})
    assert np.allclose(seen[mask][:, :6], -1) and np.array_equal(seen[~mask], last[~mask])
    with pytest.raises(ValueError, match="2 members are at their end"):
        many.step(actions)
    many.reset(options={"reset_mask": ~mask})
    assert not many.step(actions)[3].any()
    with pytest.raises(ValueError, match="need 4 booleans, one of them True"):
        many.reset(options={"reset_mask": np.zeros(4, bool)})


def test_a_vector_takes_numbers_for_each_member(getkey):
    usual = REACH.default_params()
    own = envs.randomised(usual, getkey(), 0.2, members=MEMBERS)
    mixed = eqx.tree_at(lambda p: p.young_modulus, usual, own.young_modulus)
    actions, found = np.ones((MEMBERS, 3)) * np.array([1.0, -1.0, -1.0]), []
    for params in (usual, mixed):
        many = vector("NextStep", params)
        many.reset(seed=[3, 3, 3, 3])
        for _ in range(2):
            seen = many.step(actions)[0]
        found.append(np.ptp(seen[:, 19]))
    assert found[0] < 1e-6 and found[1] > 1e-5  # the side of the tip, under one noise


def test_environments_need_no_gymnasium_until_they_are_asked_for_it():
    code = (
        "import sys; from sorojax import envs; e = envs.FingerReach(); envs.to_brax(e);"
        "assert 'gymnasium' not in sys.modules; sys.modules['gymnasium'] = None\n"
        "try: envs.to_gymnasium(e)\n"
        "except ModuleNotFoundError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "need it for its interface. Install it with `pip install 'sorojax[envs]'`" in (
        done.stdout
    ), done.stderr


def test_names_make_environments_and_vectors():
    tasks = (
        "BallTurn",
        "CrawlerRun",
        "FingerReach",
        "PickPlace",
        "SolidCrawl",
        "SolidReach",
        "TentaclePush",
        "TipTracking",
    )
    assert envs.register() == tuple(f"sorojax/{name}-v0" for name in tasks)
    many = gymnasium.make_vec(
        "sorojax/FingerReach-v0",
        num_envs=2,
        max_steps=7,
        autoreset_mode=AutoresetMode.DISABLED,
    )
    assert many.metadata["autoreset_mode"] == AutoresetMode.DISABLED
    assert many.unwrapped.env.max_steps == 7 and many.observation_space.shape == (2, 33)


@pytest.mark.parametrize(
    "key", [jax.random.key(0), jax.random.PRNGKey(0)], ids=["typed", "raw"]
)
def test_brax_finds_its_states(key):
    env = envs.to_brax(REACH)

    @jax.jit
    def run(key):
        first = jax.vmap(env.reset)(jax.random.split(key, 2))

        def one(state, _):
            after = jax.vmap(env.step)(state, jnp.ones((2, env.action_size)))
            return after, (after.done, after.info["truncation"], after.metrics["distance"])

        return jax.lax.scan(one, first, None, length=3)

    last, (done, truncation, distance) = run(key)
    assert done.tolist() == [[0, 0], [0, 0], [1, 1]] == truncation.tolist()
    assert last.obs.shape == (2, env.observation_size) and (distance > 0).all()
    assert last.pipeline_state is last.data
    other = last.replace(pipeline_state=0, obs=1)
    assert (other.data, other.obs) == (0, 1) and env.dt == REACH.period
