"""Tasks in which fingers handle a thing: a script does them, and what is dropped ends."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import grasping
from sorojax import envs
from sorojax.envs.tasks.gripping import LOST
from sorojax.units import deg, mm

BALL, PICK = envs.BallTurn(), envs.PickPlace()
SCRIPTS = [
    pytest.param(BALL, grasping.turned_in_strokes, id="BallTurn"),
    pytest.param(PICK, grasping.carried_over, id="PickPlace"),
]


@eqx.filter_jit
def begun(env, keys, params):
    return jax.vmap(lambda key: envs.reset(env, key, params)[0])(keys)


@eqx.filter_jit
def stepped(env, keys, states, actions, params):
    return jax.vmap(lambda *one: envs.step(env, *one, params))(keys, states, actions)


@pytest.mark.slow
@pytest.mark.parametrize(("env", "script"), SCRIPTS)
def test_a_script_does_what_is_asked(env, script):
    params = env.default_params()
    keys = jax.random.split(jax.random.key(3), 4)
    done = jax.jit(jax.vmap(lambda key: grasping.episode(env, script, key, params)))(keys)
    assert done.success[:, -1].all() and not done.diverged.any() and not done.dropped.any()
    start = done.reward[:, :20].mean(axis=1)  # before the fingers are there
    assert (done.reward[:, -20:].mean(axis=1) > start + 0.5).all()
    if env is BALL:
        turned = 2 * np.arctan2(done.state.body.q[..., -4], done.state.body.q[..., -7])
        wanted = np.asarray(done.state.goal.turn[:, -1])
        np.testing.assert_allclose(turned[:, -1], wanted, atol=5 * deg)
        assert (np.abs(wanted) > 29 * deg).all()
    else:
        lift = np.asarray(done.state.body.q[..., -1])
        assert (lift.max(axis=1) > 30 * mm).all()  # the shelf has 20


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_pressure_on_one_side_turns_the_ball_to_that_side(sign):
    """Counter-clockwise from above by the first chambers."""
    keys, params = jax.random.key(0)[None], BALL.default_params()
    states = begun(BALL, keys, params)
    actions = jnp.tile(jnp.asarray([1.0, -1.0][:: int(sign)]), 3)[None]
    for _ in range(40):
        after = stepped(BALL, keys, states, actions, params)
        states = after.state
    aside = np.asarray(BALL.markers(jax.tree.map(lambda x: x[0], states.body), params))[1]
    assert sign * aside[1] > 10 * mm  # the tip of the finger at y = 0, x > 0


def test_a_ball_rests_on_its_knobs_and_one_out_of_the_fingers_is_dropped(getkey):
    keys, params = jax.random.split(getkey(), 3), BALL.default_params()
    states, still = begun(BALL, keys, params), -jnp.ones((3, 6))
    q = states.body.q.at[1, -3].set(60 * mm).at[2, -1].set(80 * mm)
    states = eqx.tree_at(lambda s: s.body.q, states, q)
    after = stepped(BALL, keys, states, still, params)
    assert after.terminated.tolist() == [False, True, True]
    assert after.info["dropped"].tolist() == [False, True, True]
    assert not after.info["diverged"].any()
    assert (after.reward[1:] < 1 - LOST).all() and after.reward[0] > -1
    for _ in range(20):
        after = stepped(BALL, keys, after.state, still, params)
    lies = np.asarray(after.state.body.q[0, -3:])
    assert -0.1 * mm < lies[2] < 0 and np.abs(lies[:2]).max() < 1e-9
    assert np.abs(after.state.body.v[0, -3:]).max() < 1e-5  # m/s


def test_a_box_that_leans_falls_and_ends_the_episode(getkey):
    """Past the angle at which its middle is above an edge, atan(30 / 40) or 37 degrees."""
    keys, params = jax.random.split(getkey(), 3), PICK.default_params()
    states = begun(PICK, keys, params)
    lean = jnp.asarray([0.0, 30 * deg, 43 * deg])
    low = 15 * mm * jnp.sin(lean) + 20 * mm * jnp.cos(lean) - 20 * mm
    q = states.body.q.at[:, -3].set(lean).at[:, -1].set(low)
    states = eqx.tree_at(lambda s: s.body.q, states, q)
    over = []
    for _ in range(15):
        after = stepped(PICK, keys, states, jnp.zeros((3, 3)).at[:, 2].set(-1), params)
        states = after.state
        over.append(np.asarray(after.info["dropped"]))
    assert np.any(over, axis=0).tolist() == [False, False, True]
    assert not after.info["diverged"].any()
    assert abs(states.body.q[1, -3]) < 3 * deg  # stands again


def test_a_box_in_place_that_is_held_is_not_placed_yet(getkey):
    keys, params = jax.random.split(getkey(), 2), PICK.default_params()
    states = begun(PICK, keys, params)
    there = states.goal.target - jnp.asarray([0.0, params.box_height / 2])[None]
    low = params.shelf_height + params.box_height / 2 + 68 * mm - params.foot_height
    command = jnp.stack([there[:, 0], jnp.broadcast_to(low, (2,)), jnp.zeros(2)], axis=1)
    q = states.body.q.at[:, -2:].set(there).at[:, :2].set(command[:, :2])
    states = eqx.tree_at(
        lambda s: (s.body.q, s.supply.value, s.supply.commands),
        states,
        (q, command, jnp.broadcast_to(command[:, None], states.supply.commands.shape)),
    )
    actions = jnp.asarray([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])  # open, closed
    for _ in range(40):
        after = stepped(PICK, keys, states, actions, params)
        states = after.state
    assert after.info["success"].tolist() == [True, False]
    assert (after.info["distance"] < 5 * mm).all()
    assert after.reward[0] > after.reward[1] + 0.5


def test_each_episode_has_a_supply_of_its_own(getkey):
    for env in (BALL, PICK):
        params = env.default_params()
        line = begun(env, jax.random.split(getkey(), 4), params).goal.supply
        for name in ("lag", "dead_time"):
            drawn = np.asarray(getattr(line, name))
            low, high = (float(getattr(x, name)) for x in (params.fastest, params.supply))
            assert (low < drawn).all() and (drawn < high).all() and np.ptp(drawn) > 0
