"""Adaptive runs leave out what diffrax checks of its arguments, and nothing else."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from sorojax import Status, systems
from sorojax._jax import diffrax_checks

LAG = systems.Lag(0.1)


class Checked(systems.Lag):
    """A lag that does not take a negative input."""

    def vector_field(self, t, state, inputs):
        low = jnp.any(inputs["a"] < 0)
        return super().vector_field(t, eqx.error_if(state, low, "negative"), inputs)


def run(block, level, end):
    network = systems.Network({"lag": block}, {}, exposed=("lag.a",))
    return systems.simulate(network, end, inputs={"lag.a": level}, save=3, throw=False)


@pytest.mark.skipif(diffrax_checks.status() != "on", reason=diffrax_checks.status())
def test_an_adaptive_run_does_not_call_the_host():
    text = jax.jit(lambda level: run(LAG, level, 1.0).status).lower(1.0).as_text()
    assert "callback" not in text


def test_checks_within_a_field_stay():
    assert run(Checked(0.1), 1.0, 1.0).status == Status.successful
    with pytest.raises(Exception, match="negative"):
        jax.block_until_ready(run(Checked(0.1), -1.0, 1.0).state)


def test_checks_of_other_runs_stay():
    run(LAG, 1.0, 1.0)
    term, save = dfx.ODETerm(lambda t, y, _: -y), dfx.SaveAt(ts=jnp.array([0.8, 0.2]))
    with pytest.raises(Exception, match="must be increasing"):
        dfx.diffeqsolve(term, dfx.Tsit5(), 0.0, 1.0, 0.1, 1.0, saveat=save)


def test_time_that_runs_backwards_is_no_success():
    ended = jax.jit(lambda end: run(LAG, 1.0, end).status)
    assert ended(1.0) == Status.successful
    assert ended(-1.0) != Status.successful
