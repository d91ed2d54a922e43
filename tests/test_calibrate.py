"""Calibration: known answers, uncertainties by repetition, bounds, what is not seen."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from sorojax import SE2, design, fem, material, mesh, rod as R, systems as S
from sorojax._progress import listen, silent
from sorojax.design.calibration.calibration import directions_of, sensitivity
from sorojax.math.status import Status

TIMES = jnp.linspace(0.0, 2.0, 9)
TRUTH = {"offset": -0.3, "rate": 1.5, "size": 2.0}
LOGARITHMIC = {"offset": False, "rate": True, "size": True}


@jax.jit
def decay(p):
    return p["size"] * jnp.exp(-p["rate"] * TIMES) + p["offset"]


@jax.jit
def slopes(p):
    return jnp.stack([p["size"] * p["rate"], p["size"] + p["offset"]])


NOISE = (0.02, jnp.array([0.05, 0.03]))


def records(key=None):
    """Two experiments with sensors of their own; exact without a key."""
    truth = jax.tree.map(jnp.asarray, TRUTH)
    exact = (decay(truth), slopes(truth))
    keys = (None, None) if key is None else jax.random.split(key)
    return tuple(
        design.Experiment(
            f, y if k is None else y + n * jax.random.normal(k, y.shape), n, name=f.__name__
        )
        for f, y, n, k in zip((decay, slopes), exact, NOISE, keys, strict=True)
    )


GUESS = {"offset": 0.1, "rate": 0.4, "size": 1.0}


def fitted(experiments, **options):
    with silent():
        return design.calibrate(experiments, GUESS, logarithmic=LOGARITHMIC, **options)


def flat(found):
    return np.array([found.parameters[name] for name in found.names])


def test_known_parameters_come_back():
    found = fitted(records())
    assert found.status == Status.successful and found.names == ("offset", "rate", "size")
    assert np.allclose(flat(found), [-0.3, 1.5, 2.0], rtol=1e-9)
    assert found.misfit < 1e-16 and found.freedom == 8 and design.unidentifiable(found) == ()
    assert np.all(np.diff(found.history["misfit"]) < 0)


def test_the_covariance_is_that_of_repetition():
    """Standard errors and correlations against 120 fits of fresh noise."""
    keys = jax.random.split(jax.random.key(3), 120)
    with silent():
        found = [
            design.calibrate(records(key), TRUTH, logarithmic=LOGARITHMIC, tolerance=1e-3)
            for key in keys
        ]
    values = np.array([flat(each) for each in found])
    stated = fitted(records())
    repeated = np.cov(values.T)
    deviation = np.sqrt(np.diag(repeated))
    # the standard deviation of 120 draws is known to 6.5 %
    assert np.allclose(np.sqrt(np.diag(stated.covariance)), deviation, rtol=0.2)
    assert np.allclose(stated.correlation, repeated / np.outer(deviation, deviation), atol=0.15)
    assert np.isclose(np.mean([each.reduced_misfit for each in found]), 1.0, atol=0.15)


def test_noise_weighs_and_missing_readings_are_left_out():
    decays, other = records()
    wrong = design.Experiment(slopes, other.measured + 0.5, 1e3, name="useless")
    assert np.allclose(flat(fitted((decays, wrong))), [-0.3, 1.5, 2.0], rtol=1e-4)
    holed = design.Experiment(decay, decays.measured.at[3].set(jnp.nan), 0.02)
    found = fitted((holed, other))
    assert found.freedom == 7 and np.allclose(flat(found), [-0.3, 1.5, 2.0], rtol=1e-9)
    assert np.isnan(found.experiments[0].error[3])


@pytest.mark.parametrize("side", ["lower", "upper"])
def test_bounds_hold_and_the_others_are_the_best_within(side):
    bound = {"lower": 1.8, "upper": 1.2}[side]
    far = jnp.inf if side == "upper" else -jnp.inf
    limits = {"offset": far, "rate": bound, "size": far}
    start = {"offset": 0.1, "rate": {"lower": 2.5, "upper": 0.4}[side], "size": 1.0}
    experiments = records(jax.random.key(1))
    with silent():
        found = design.calibrate(experiments, start, logarithmic=LOGARITHMIC, **{side: limits})
    box = [(-np.inf, np.inf)] * 3
    box[1] = (bound, np.inf) if side == "lower" else (-np.inf, bound)

    def errors(p):
        tree = dict(zip(found.names, map(jnp.asarray, p), strict=True))
        return np.concatenate([e.errors(e.predict(tree)) for e in experiments])

    start = np.array([start[name] for name in found.names])
    peer = scipy.optimize.least_squares(errors, start, bounds=np.array(box).T, xtol=1e-12)
    assert np.allclose(flat(found), peer.x, rtol=1e-5)
    assert list(found.at_bound) == [False, True, False]
    assert found.covariance[1, 1] == 0 and found.freedom == 9
    assert found.status == Status.successful


def test_what_no_experiment_sees_is_named():
    """Under its own weight a beam shows stiffness over density, and nothing else."""

    @jax.jit
    def sag(p):
        return p["density"] / p["modulus"] * jnp.array([1.0, 2.0, 5.0])

    start = {"density": 3.0, "modulus": 2.0}
    truth = design.Experiment(sag, 0.5 * jnp.array([1.0, 2.0, 5.0]), 0.01)
    with silent():
        found = design.calibrate((truth,), start)
    assert found.status == Status.successful
    (blind,) = design.unidentifiable(found)
    assert np.allclose(list(blind.weights.values()), np.sqrt(0.5)) and "density" in str(blind)
    assert np.all(np.isinf(np.diag(found.covariance))) and np.all(np.isnan(found.correlation))
    assert np.isclose(found.parameters["density"] / found.parameters["modulus"], 0.5)
    scale = design.Experiment(jax.jit(lambda p: p["density"]), 1.0, 0.02)
    with silent():
        both = design.calibrate((truth, scale), start, hold_out=(truth,))
    assert design.unidentifiable(both) == () and np.isclose(both.parameters["modulus"], 2.0)
    assert np.isclose(both.standard_errors["density"], 0.02)
    assert "held out" in str(both) and "modulus" in str(both)


def test_a_record_held_out_is_predicted_with_its_uncertainty():
    decays, other = records(jax.random.key(5))
    found = fitted((decays,), hold_out=(other,))
    (check,) = found.held_out
    assert np.allclose(check.predicted, slopes(found.parameters))
    grad = jax.jacfwd(slopes)(found.parameters)
    rows = np.stack([grad[name] for name in found.names], axis=1)
    assert np.allclose(check.expected, np.sqrt(np.diag(rows @ found.covariance @ rows.T)))
    assert np.isclose(check.rms, np.sqrt(np.mean((check.error / other.noise) ** 2)))
    assert design.validate(found, (other,))[0].rms == check.rms


def test_parameters_without_an_answer_are_steps_too_long():
    """A model that breaks beyond 3, asked from a place whose first step leads there."""

    def breaking(p):
        if float(p) > 3.0:
            raise fem.ConvergenceError("no equilibrium", None)  # pyright: ignore
        return jnp.stack([p**0.1, p**0.1])

    record = design.Experiment(breaking, [2.9**0.1] * 2, 1e-3, differentiable=False)
    broken = design.Experiment(jax.jit(lambda p: jnp.log(3 - p)[None]), [np.log(0.1)], 1e-2)
    with silent():
        for each, start in ((record, 0.1), (broken, 0.1)):
            found = design.calibrate((each,), jnp.asarray(start), logarithmic=False)
            assert np.isclose(found.parameters, 2.9, rtol=1e-5)


def test_stopped_and_resumed_gives_the_same_bits():
    experiments = records(jax.random.key(2))
    seen = []
    whole = fitted(experiments, steps=6, on_step=seen.append)
    half = fitted(experiments, steps=3)
    assert half.status == Status.max_steps and seen[-1].count == whole.last.count
    rest = fitted(experiments, steps=6, resume=half.last)
    assert np.array_equal(flat(whole), flat(rest)) and rest.misfit == whole.misfit
    reports = []
    with listen(reports.append):
        design.calibrate(experiments, GUESS, logarithmic=LOGARITHMIC, steps=2)
    assert reports[-1].label == "calibrate" and reports[-1].numbers["misfit"] > 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(start={"offset": 0.0, "rate": -1.0, "size": 1.0}), "positive number for its log"),
        (dict(lower=0.2), "`offset` starts at 0.1, its bounds"),
        (dict(lower={"offset": 1.0}), "`lower` does not fit"),
        (dict(start={"offset": jnp.nan, "rate": 1.0, "size": 1.0}), "must be finite"),
        (dict(experiments=()), "at least one"),
        (dict(start={"offset": 0.0, "rate": 1e200, "size": 1.0}), "not finite at the first"),
    ],
)
def test_wrong_calls_are_refused(change, message):
    options = {"experiments": records(), "start": GUESS, "logarithmic": LOGARITHMIC} | change
    if message.startswith("not finite"):
        bad = design.Experiment(jax.jit(lambda p: jnp.sqrt(-p["rate"])), 1.0, 1.0)
        options["experiments"] = (bad,)
    with silent(), pytest.raises(ValueError, match=message):
        design.calibrate(options.pop("experiments"), options.pop("start"), **options)


def test_wrong_records_are_refused():
    with pytest.raises(ValueError, match="broadcasts to"):
        design.Experiment(decay, jnp.zeros(9), jnp.ones(4))
    with pytest.raises(ValueError, match="no reading"):
        design.Experiment(decay, jnp.full(9, jnp.nan), 1.0)
    with pytest.raises(ValueError, match="must be positive"):
        design.Experiment(decay, jnp.zeros(9), 0.0)
    with pytest.raises(ValueError, match="shape \\(9,\\), need \\(4,\\)"), silent():
        design.calibrate(
            (design.Experiment(decay, jnp.zeros(4), 1.0),), GUESS, logarithmic=False
        )


BEAM = mesh.rectangle([0, 0], [0.1, 0.02], divisions=(5, 1), element=mesh.Quad4())
END = jnp.array([mesh.nearest_node(BEAM, [0.1, 0.0])])
BEAM_PROBLEM = fem.problem(
    BEAM,
    material.neo_hookean(young_modulus=2e5, poisson_ratio=0.4, density=1100.0),
    kinematics=fem.PlaneStress(0.02),
    supports=(fem.Fixed(BEAM.node_sets["left"]),),
    loads=(fem.Gravity((0.0, -9.81)), fem.Force(END, [0.0, -1.0])),
    formulation=fem.Displacement(),
)


def hanging(p, weight):
    """Sag of the end of a beam under its own and a further weight [N]."""
    shear = p["young"] / 2.8
    rubber = material.NeoHookean(shear, shear * 4.667, p["density"])
    pull = jnp.stack([0 * weight, -weight])
    problem = fem.with_load(replace(BEAM_PROBLEM, material=rubber), "force", pull)
    return fem.solve(problem).displacement[END[0]]


@jax.jit
def bent(p, force):
    """Tip of a rod under its own weight and a dead force across it [N]."""
    body = R.rod(
        SE2(),
        R.chebyshev(kappa_z=2),
        R.circle(6e-3),
        length=0.08,
        young_modulus=p["young"],
        poisson_ratio=0.4,
        density=p["density"],
    )
    wrench = R.TipWrench(jnp.stack([0 * force, 0 * force, force]))
    rest = R.equilibrium(body, (wrench, R.Gravity([0.0, 9.81])))
    return R.tip_pose(body, rest.q)[:2, 2]


@jax.jit
def filled(p, gain):
    """Pressure behind a lag, driven by a step."""
    network = S.Network(
        {
            "in": S.Source(S.Constant(p["density"]), unit="Pa"),
            "lag": S.Lag(p["young"] / 2e5 * gain, unit="Pa"),
        },
        {"lag.a": "in.value"},
    )
    return S.simulate(network, 1.0, save=5, step=0.02)["lag.value"][1:]


@pytest.mark.parametrize(
    ("model", "sizes"),
    [(hanging, (0.0, 0.03)), (bent, (0.0, 0.05)), (filled, (0.1, 0.3))],
    ids=["solid", "rod", "network"],
)
def test_equilibria_and_motions_are_calibrated_by_their_own_derivatives(model, sizes):
    truth = {"young": jnp.asarray(2e5), "density": jnp.asarray(1100.0)}
    models = [lambda p, s=s: model(p, jnp.asarray(s)) for s in sizes]
    experiments = [design.Experiment(f, f(truth), 1e-4) for f in models]
    unit = directions_of(truth, np.diag([1100.0, 2e5]))
    errors, moved = sensitivity(experiments[0], truth, unit)
    rough = design.Experiment(models[0], experiments[0].measured, 1e-4, differentiable=False)
    _, difference = sensitivity(rough, truth, unit)
    assert np.abs(errors).max() < 1e-6
    assert np.allclose(moved, difference, rtol=1e-4, atol=1e-5 * np.abs(moved).max())
    with silent():
        found = design.calibrate(experiments, {"young": 1.4e5, "density": 900.0})
    assert np.isclose(found.parameters["young"], 2e5, rtol=1e-6)
    assert np.isclose(found.parameters["density"], 1100.0, rtol=1e-6)
