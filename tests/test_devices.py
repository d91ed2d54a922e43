"""Kernels on accelerators: what differs there, as far as a CPU can show it."""

from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import devices, discover, page, rows
from benchmarks.blocks import bent, block
from benchmarks.cases import device_envs
from benchmarks.fingers import finger, random_states
from benchmarks.single import narrow
from sorojax import envs, fem, mesh, rod as R
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.math import compiled as compiled_module


@pytest.mark.parametrize("name", ["device.envs", "device.fem", "device.rods", "device.sdf"])
def test_without_an_accelerator_a_case_says_so(name):
    (row,) = discover.load(name, discover.cases()[name]).rows()
    assert "Install jax[cuda13]" in row.settings["reason"]


def test_both_devices_have_a_row_with_their_error():
    cpu = devices.found()[0]
    x = jnp.linspace(0.0, 1.0, 8)
    exact = devices.on_cpu(jnp.sin, x)
    for double, error in ((True, 0.0), (False, 1e-7)):
        rows = devices.compared(
            "sine",
            jnp.sin,
            (x,),
            count=8,
            of="points",
            error_of=devices.relative(exact),
            bar=1e-6,
            reference="CPU",
            devices=[cpu, cpu],
            double=double,
        )
        for row in rows:
            assert row.holds and row.error <= error
            assert row.settings["device"] == "one CPU core"


def test_steps_of_environments_have_rows_on_both_devices(monkeypatch):
    """Two CPUs stand for both."""
    monkeypatch.setattr(devices, "found", lambda: devices.jax.devices("cpu")[:1] * 2)
    monkeypatch.setattr(device_envs, "quick", lambda: True)
    found = list(device_envs.rows({"finger": (envs.FingerReach, (True,))}, shared=64))
    assert [row.settings["members"] for row in found] == [64, 64, 1024]
    assert all(row.holds for row in found) and found[0].error < 1e-9


def test_an_accelerator_takes_all_cells_at_once_with_the_same_tangent(monkeypatch):
    def tangent():
        problem = block(mesh.Quad4(), (9, 31), fem.Displacement())
        u = bent(problem.mesh.points)
        return problem.space.cells.shape, linearise(problem, prepare(problem), u, u)

    shape, narrow_blocks = tangent()
    monkeypatch.setattr(import_module("sorojax.fem.assembly.space"), "platform", lambda: "gpu")
    wide_shape, wide_blocks = tangent()
    assert shape == (2, 4, 256) and wide_shape == (1, 4, 279)
    for name in ("residual", "values"):
        a, b = (np.asarray(getattr(x, name)) for x in (narrow_blocks, wide_blocks))
        assert np.abs(a - b).max() <= 1e-13 * np.abs(a).max()


def test_products_of_single_precision_keep_its_digits(monkeypatch):
    def trace(x):
        verb = compiled_module.jit_public(lambda x: x @ x)
        return str(jax.make_jaxpr(lambda x: verb(x))(x))

    x = jnp.ones((2, 2), jnp.float32)
    assert "HIGHEST" not in trace(x)
    monkeypatch.setattr(compiled_module, "platform", lambda: "gpu")
    assert "HIGHEST" in trace(x)
    with jax.default_matmul_precision("bfloat16"):
        assert "HIGHEST" not in trace(x)


@pytest.fixture
def rounded_factors(monkeypatch):
    """Products as on recent accelerators: factors of 10 bits where nobody asks for more."""
    from jax._src.lax import lax

    product = lax.dot_general

    def rounding(a, b, *args, precision=None, **kwargs):
        asked = precision or jax.config.jax_default_matmul_precision
        if a.dtype == jnp.float32 and "HIGHEST" not in str(asked).upper():
            a, b = (jax.lax.reduce_precision(x, 8, 10) for x in (a, b))
        return product(a, b, *args, precision=precision, **kwargs)

    monkeypatch.setattr(lax, "dot_general", rounding)
    jax.clear_caches()
    yield
    jax.clear_caches()


@pytest.mark.parametrize("by", ["jit_public", "field"])
@pytest.mark.parametrize("device", ["gpu", "cpu"])
def test_rods_in_single_precision_where_factors_are_rounded(
    by, device, rounded_factors, monkeypatch
):
    body, (q, *_), (v, *_) = finger(8), *random_states(1)
    gravity = (R.Gravity(),)
    exact = R.forward_dynamics(body, jnp.asarray(q), jnp.asarray(v), gravity)
    monkeypatch.setattr(compiled_module, "platform", lambda: device)
    body, q, v = narrow((body, jnp.asarray(q), jnp.asarray(v)))
    if by == "jit_public":
        found = jax.jit(lambda *x: R.forward_dynamics(*x, gravity))(body, q, v)
    else:
        found = jax.jit(lambda body, *x: R.vector_field(body, gravity)(0.0, x)[1])(body, q, v)
    error = jnp.abs(found.astype(jnp.float64) - exact).max() / jnp.abs(exact).max()
    assert found.dtype == jnp.float32
    # Without the request for all digits such a device is far off, and the test could not fail.
    # The bound is that of `test_single_precision_keeps_its_digits`.
    assert error < 8e-4 if device == "gpu" else error > 5e-3


def test_motion_in_single_precision_stays_single():
    body, (q,), (v,) = finger(8), *random_states(1)
    args = body, jnp.asarray(q), jnp.asarray(v), (R.Gravity(),)
    paths = [R.rollout(*given, step=1e-3, saves=2) for given in (narrow(args), args)]
    assert paths[0].q.dtype == paths[0].time.dtype == jnp.float32
    scale = jnp.abs(paths[1].q).max()
    assert jnp.abs(paths[0].q.astype(jnp.float64) - paths[1].q).max() < 1e-4 * scale


def test_bodies_have_every_row_and_a_page():
    """What an accelerator is compared in, by the CPU alone."""
    case = discover.load("device.fem", discover.cases()["device.fem"])
    small = block(mesh.Quad4(), (3, 3), fem.Displacement())
    told = list(case._rows(devices.found()[0], small, {}))
    assert [row.settings["method"].split(",")[0] for row in told] == [
        "tangent",
        "product",
        "product of a stored matrix",
        "linear system",
        "equilibrium",
    ]
    assert all(row.holds is not False for row in told)
    text = page.html([rows.line("device.fem", row) for row in told], {}, [])
    assert text.count("<tr>") > len(told)
