"""Measured robots of `python -m benchmarks validation`: their data, and the tentacle."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from benchmarks.validation import beam, tensile, tentacle, tentacle_film
from sorojax.units import mm


@pytest.fixture(scope="module")
def record():
    return tentacle.read()


def test_poses_are_read_and_others_have_no_recording(record, tmp_path):
    assert record.tension.shape == (14, 2) and record.markers.shape == (14, 4, 3)
    assert np.all(record.markers[:, 3, 2] < 0) and np.abs(record.markers).max() < 0.4
    assert record.second.tolist() == [0] * 6 + [1] * 8
    poses = json.loads(tentacle.POSES.read_text())["poses"][:2]
    poses[1]["recording"] = 2
    file = tmp_path / "poses.json"
    file.write_text(json.dumps({"poses": poses}))
    assert tentacle.read(file).second.tolist() == [0.5, 1.0]
    file.write_text(json.dumps({"poses": [{"tension_N": [1.0], "markers_mm": [[0, 0, 0]]}]}))
    with pytest.raises(ValueError, match="need .poses, 2"):
        tentacle.read(file)


@pytest.mark.parametrize(("load", "drop", "frequency"), [(0.0, 6.4, 7.7), (0.51012, 17.0, 4.3)])
def test_drop_and_swing_of_the_beam_are_read(load, drop, frequency):
    for swing in beam.measured(load):
        np.testing.assert_allclose(swing.drops.mean(), drop, rtol=0.03)
        np.testing.assert_allclose(swing.frequency, frequency, rtol=0.02)
        assert 0.045 < swing.ratio < 0.065


def test_rubbers_in_tension_are_predicted():
    """The points that were fitted, those that were not, and what a small bulk modulus does."""
    rubber = "Ecoflex 00-30"
    found = tensile.predict(rubber, tensile.Yeoh)
    assert np.abs(found.error[:6]).max() < 0.1 and np.abs(found.error[6:]).max() < 0.03
    assert np.all(np.isfinite(found.fit.covariance))  # with c2 = 0, at its bound
    softer = tensile.predict(rubber, tensile.Yeoh, tensile.USUAL_RATIO)
    np.testing.assert_allclose(softer.fit.rms, found.fit.rms)
    assert -0.055 < softer.error[5] - found.error[5] < -0.035


def test_a_tendon_bends_the_tentacle_to_its_side(record):
    p, model = tentacle.parameters(), jax.jit(tentacle.markers)
    tips = []
    for k, side in ((0, 1), (3, -1)):  # one tendon each, as strong
        found = np.asarray(model(p, record.tension[k], record.second[k]))
        tip, measured = found[3], record.markers[k, 3]
        assert tip[0] > 0 and side * tip[1] > 60 * mm
        assert np.linalg.norm(tip - measured) < 25 * mm  # before any fit; it has moved 130
        tips.append(tip)
    np.testing.assert_allclose(tips[0] * [1, -1, 1], tips[1], atol=1e-9)


def test_the_slope_of_the_marker_error_is_that_of_differences(record):
    start = tentacle.parameters()
    start["rest_curvature"] = jnp.full((2, 2), 0.3)
    start["tilt"] = jnp.array([0.02, -0.01, 0.03])
    flat, back = ravel_pytree(start)

    @jax.jit
    def error(x):
        found = tentacle.markers(back(x), record.tension[12], record.second[12])
        return jnp.sum((found - record.markers[12]) ** 2)

    slope = np.asarray(jax.jit(jax.grad(error))(flat))
    scale = np.maximum(np.abs(np.asarray(flat)), 1e-2)
    differences = []
    for k, size in enumerate(1e-4 * scale):
        ends = [float(error(flat.at[k].add(s * size))) for s in (-1, 1)]
        differences.append((ends[1] - ends[0]) / (2 * size))
    found, expected = slope * scale, np.array(differences) * scale
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    assert np.count_nonzero(found) == len(flat)


@pytest.mark.slow
def test_the_film_shows_what_was_measured_where_it_stands_still(record):
    """Of two poses before any fit: red markers while a pose is held, none between."""
    two = tentacle.Record(record.tension[:2], record.markers[:2], record.second[:2])
    film = tentacle_film.film(tentacle.parameters(), two, size=(240, 280))
    assert film.frames == 2 * tentacle_film.HELD + tentacle_film.MOVING

    def red(k):  # the axes of the picture are red too
        red, green, blue = film.draw(k).astype(int).transpose(2, 0, 1)
        return np.count_nonzero((red > green + 80) & (red > blue + 80))

    held, moving = red(0), red(tentacle_film.HELD + 2)
    assert held > moving + 10 and red(film.frames - 1) > moving + 10
    tips = [film.draw(k) for k in (0, film.frames - 1)]
    assert np.count_nonzero(tips[0] != tips[1]) > 100
