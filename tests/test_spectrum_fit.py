"""Tests of viscoelastic materials: what they read, and the spectra that are fitted to them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks.validation import beam
from sorojax import design, fem, material, mesh, replace
from sorojax.material import CreepTest, DynamicTest, Prony, RelaxationTest, RingDown

MODULUS = 2e5
SPECTRA = {
    1: Prony([0.5], [0.3]),
    3: Prony([0.5, 0.3, 0.4], [1e-2, 0.3, 6.0]),
    5: Prony([0.5, 0.3, 0.2, 0.4, 0.3], [1e-3, 2e-2, 0.2, 3.0, 40.0]),
}
KINDS = ("relaxation", "creep", "dynamic", "ring-down")
TIME = np.geomspace(5e-5, 800.0, 60)  # one range, so that all fits share their programs
FREQUENCY = 1 / (2 * np.pi * TIME)


def measured(kind, spectrum, noise=0.0, seed=0):
    """A test of `TIME` or `FREQUENCY` with relative noise."""
    rng = np.random.default_rng(seed)

    def read(values):
        values = np.asarray(values)
        return values * (1 + noise * rng.standard_normal(values.shape))

    omega = 2 * np.pi * FREQUENCY
    if kind == "relaxation":
        return RelaxationTest(TIME, read(MODULUS * material.relaxation_modulus(spectrum, TIME)))
    if kind == "creep":
        return CreepTest(TIME, read(material.creep_compliance(spectrum, TIME) / MODULUS))
    if kind == "dynamic":
        storage = material.storage_modulus(spectrum, omega)
        loss = material.loss_modulus(spectrum, omega)
        return DynamicTest(FREQUENCY, read(MODULUS * storage), read(MODULUS * loss))
    return RingDown(FREQUENCY, read(damping_ratios(spectrum, FREQUENCY)))


def damping_ratios(spectrum, frequency):
    """Those of swings of such frequencies: the ratio that predicts itself."""
    ratio = np.full(frequency.shape, 0.05)
    for _ in range(200):
        ratio = np.asarray(
            material.predicted_readings(RingDown(frequency, ratio), 1.0, spectrum)
        )
    return ratio


# ---- what a test reads


def test_creep_is_that_of_springs_and_dampers_in_time():
    spectrum = SPECTRA[3]
    g, tau = np.asarray(spectrum.shares), np.asarray(spectrum.times)
    time = np.array([0.0, 1e-3, 0.02, 0.5, 7.0, 40.0])

    def strain(dampers):  # of a unit stress, dampers at rest at first
        return (1 + g @ dampers) / (1 + g.sum())

    flow = solve_ivp(
        lambda _, dampers: (strain(dampers) - dampers) / tau,
        (0, 40), np.zeros(3), "Radau", time, rtol=1e-10, atol=1e-12,
    )  # fmt: skip
    found = material.creep_compliance(spectrum, time)
    assert np.allclose(found, [strain(each) for each in flow.y.T], rtol=1e-8)


def test_creep_begins_with_the_instantaneous_and_ends_with_the_long_time_modulus():
    """Also of times that span eight decades, and of a branch without a share."""
    wide = Prony([0.4, 0.0, 0.7, 0.1], [1e-4, 1e-2, 1.0, 1e4])
    found = material.creep_compliance(wide, [0.0, 1e7])
    ends = np.array([float(material.long_time_share(wide)), 1.0])
    assert np.allclose(found, ends, rtol=1e-10)
    without = Prony([0.4, 0.7, 0.1], [1e-4, 1.0, 1e4])
    time = np.geomspace(1e-5, 1e5, 20)
    both = [material.creep_compliance(each, time) for each in (wide, without)]
    assert np.allclose(*both, rtol=1e-10)


def test_creep_has_a_slope_by_a_share_of_zero():
    def compliance(share):
        return material.creep_compliance(Prony([0.4, share], [0.1, 1.0]), 0.7)

    step = 1e-4
    values = [float(compliance(k * step)) for k in range(3)]
    one_sided = (4 * values[1] - 3 * values[0] - values[2]) / (2 * step)
    for slope in (jax.grad(compliance)(0.0), jax.jvp(compliance, (0.0,), (1.0,))[1]):
        assert np.isclose(slope, one_sided, rtol=1e-6)


def test_ring_down_is_the_slow_decay_of_a_mass_on_springs_and_dampers():
    """Eigenvalues of mass, spring and branches: light and heavy damping."""
    for spectrum in (SPECTRA[3], Prony([1.5], [0.02])):
        g, tau = np.asarray(spectrum.shares), np.asarray(spectrum.times)
        n = len(g)
        for mass in (1e-4, 1e-2, 1.0):
            A = np.zeros((n + 2, n + 2))  # of displacement, speed, and strains of the dampers
            A[0, 1] = 1
            A[1, 0], A[1, 2:] = -(1 + g.sum()) / mass, g / mass
            A[2:, 0], A[2:, 2:] = 1 / tau, -np.diag(1 / tau)
            values = np.linalg.eigvals(A)
            s = values[np.argmax(values.imag)]
            test = RingDown([s.imag / (2 * np.pi)], [-s.real / abs(s)])
            found = material.predicted_readings(test, 1.0, spectrum)
            assert np.allclose(found, test.readings, rtol=1e-10)


def test_small_losses_are_twice_the_damping_ratio():
    faint = Prony([1e-3], [0.1])
    test = RingDown([1.0, 3.0], damping_ratios(faint, np.array([1.0, 3.0])))
    omega = 2 * np.pi * test.frequency
    factor = material.loss_modulus(faint, omega) / material.storage_modulus(faint, omega)
    assert np.allclose(2 * test.damping_ratio, factor, rtol=1e-3)


def test_readings_are_predicted_under_jit_and_vmap():
    test, moduli = measured("creep", SPECTRA[1]), jnp.array([1e5, 2e5])
    predict = jax.jit(lambda m: material.predicted_readings(test, m, SPECTRA[1]))
    found = jax.vmap(predict)(moduli)
    assert np.allclose(found[1], test.readings, rtol=1e-12)
    assert np.allclose(found[0], 2 * test.readings, rtol=1e-12)


# ---- what is fitted


@pytest.mark.parametrize("kind", [*KINDS, "all"])
def test_exact_readings_give_the_spectrum_back(kind):
    for count, spectrum in SPECTRA.items():
        kinds = KINDS if kind == "all" else (kind,)
        fit = material.fit_spectrum([measured(each, spectrum) for each in kinds])
        assert len(fit.in_range) == count and all(fit.in_range)
        assert max(fit.relative_rms) < 1e-9
        if kind == "ring-down":
            assert np.isnan(fit.modulus) and fit.covariance.shape == (2 * count,) * 2
        else:
            assert np.isclose(fit.modulus, MODULUS, rtol=1e-8)
        omega = 1 / TIME
        for verb, at in (
            (material.relaxation_modulus, TIME),
            (material.creep_compliance, TIME),
            (material.storage_modulus, omega),
            (material.loss_modulus, omega),
        ):
            assert np.allclose(verb(fit.spectrum, at), verb(spectrum, at), rtol=1e-6)


@pytest.mark.parametrize("kind", ["relaxation", "dynamic"])
def test_noisy_readings_keep_the_number_of_branches_and_the_stated_errors(kind):
    """30 repeats with 1 % noise; errors over standard errors have a deviation of one."""
    spectrum, right, ratios = SPECTRA[3], 0, []
    truth = np.log([MODULUS, *map(float, spectrum.shares), *map(float, spectrum.times)])
    for seed in range(30):
        fit = material.fit_spectrum([measured(kind, spectrum, 0.01, seed)])
        assert all(share > 0 for share in fit.spectrum.shares) and fit.modulus > 0
        assert 0.005 < fit.relative_rms[0] < 0.015
        if len(fit.in_range) == 3:
            right += 1
            numbers = [fit.modulus, *map(float, fit.spectrum.shares + fit.spectrum.times)]
            ratios.append((np.log(numbers) - truth) / np.sqrt(np.diag(fit.covariance)))
    errors = np.array(ratios)
    assert right >= 24
    assert 0.8 < errors.std() < 1.25 and np.mean(np.abs(errors) < 3) > 0.98


def test_large_noise_leaves_the_modulus_unbiased():
    """8 repeats with 10 % noise: the mean is within 3 of its standard errors."""
    fits = [
        material.fit_spectrum([measured("relaxation", SPECTRA[3], 0.1, seed)])
        for seed in range(8)
    ]
    errors = np.log([fit.modulus / MODULUS for fit in fits])
    deviation = np.sqrt(np.mean([fit.covariance[0, 0] for fit in fits]))
    assert abs(errors.mean()) < 3 * deviation / np.sqrt(8)
    assert np.all(np.abs(errors) < 4 * deviation)


def test_the_criterion_is_least_at_the_number_that_it_chooses():
    fit = material.fit_spectrum([measured("relaxation", SPECTRA[3], 0.01, 7)])
    assert min(fit.criterion, key=fit.criterion.__getitem__) == len(fit.in_range) == 3
    assert set(fit.criterion) >= {1, 2, 3}
    asked = material.fit_spectrum([measured("relaxation", SPECTRA[3], 0.01, 7)], branches=2)
    assert len(asked.in_range) == 2 and asked.relative_rms[0] > fit.relative_rms[0]


def test_stated_noise_weighs_readings_and_sets_the_errors():
    """A hundred times the noise in half of the readings that are wrong: as if without them."""
    time = np.geomspace(0.01, 10, 12)
    exact = MODULUS * np.asarray(material.relaxation_modulus(SPECTRA[1], time))
    noise = np.where(np.arange(12) % 3, 1e-6, 1.0)
    wrong = np.where(noise == 1.0, 1.5 * exact, exact)
    fit = material.fit_spectrum([RelaxationTest(time, wrong, noise=noise)], branches=1)
    assert np.isclose(fit.modulus, MODULUS, rtol=1e-5)
    small, large = (
        material.fit_spectrum([RelaxationTest(time, exact, noise=each)], branches=1).covariance
        for each in (0.01, 0.03)
    )
    assert np.allclose(9 * small, large, rtol=1e-6)


def test_a_time_beyond_the_readings_is_marked():
    late = np.geomspace(0.1, 10, 20)  # of a branch of 0.05 s only the tail
    test = RelaxationTest(
        late, MODULUS * material.relaxation_modulus(Prony([5.0], [0.05]), late)
    )
    fit = material.fit_spectrum([test])
    assert fit.in_range == (False,) and "not in range" in str(fit)
    assert np.isclose(fit.spectrum.times[0], 0.05, rtol=1e-6)


def test_the_swings_of_a_measured_beam_are_those_of_the_preset():
    """Dragon Skin 10, four records under two loads: 0.056, 0.052, 0.054 and 0.056."""
    swings = [swing for load in beam.FILES for swing in beam.measured(load)]
    test = RingDown([swing.frequency for swing in swings], [swing.ratio for swing in swings])
    fit = material.fit_spectrum([test])
    assert len(fit.in_range) == 1 and np.sqrt(fit.covariance[0, 0]) < 0.03
    (quoted,) = [p.relaxation for p in material.presets.PRESETS if p.name == "dragon_skin_10"]
    assert quoted is not None
    assert np.isclose(fit.spectrum.shares[0], quoted.shares[0], rtol=1e-3)
    assert np.isclose(fit.spectrum.times[0], quoted.times[0], rtol=1e-3)
    assert np.isclose(fit.relative_rms[0], quoted.relative_rms, rtol=1e-2)
    seen = np.asarray(test.frequency)
    assert np.allclose(quoted.frequency_range, [seen.min(), seen.max()], atol=0.01)


def test_a_spectrum_is_calibrated_together_with_a_shape():
    """Ring-downs tell the shares, the shape of a loaded block the modulus."""
    cells = mesh.rectangle([0, 0], [2, 1], divisions=(1, 1))
    pull = fem.Traction(cells.facet_sets["right"], (2e4, 0.0))
    problem = fem.problem(
        cells, material.neo_hookean(young_modulus=MODULUS, poisson_ratio=0.4),
        kinematics=fem.PlaneStrain(), loads=(pull,),
        supports=(fem.Fixed(cells.node_sets["left"]),),
    )  # fmt: skip

    def shape(p):
        rubber = material.neo_hookean(young_modulus=p["modulus"], poisson_ratio=0.4)
        return fem.solve(replace(problem, lambda p: p.material, rubber)).displacement

    swings = measured("ring-down", SPECTRA[1])

    def ratios(p):
        return material.predicted_readings(swings, 1.0, Prony(p["shares"], p["times"]))

    truth = {"modulus": MODULUS, "shares": jnp.array([0.5]), "times": jnp.array([0.3])}
    records = [
        design.Experiment(shape, shape(truth), 1e-3, name="shape"),
        design.Experiment(ratios, swings.readings, 0.02 * swings.readings, name="ring-down"),
    ]
    start = {"modulus": 1e5, "shares": jnp.array([0.2]), "times": jnp.array([1.0])}
    found = design.calibrate(records, start).parameters
    for name, value in truth.items():
        assert np.allclose(found[name], value, rtol=1e-6), name


# ---- what is refused

ROW, FALLING = [0.1, 1.0, 10.0], [3e5, 2.4e5, 2e5]
GOOD = RelaxationTest(ROW, FALLING)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: RelaxationTest([0.1, 10, 1], FALLING), "`time` 2 is 1 s after 10 s.*Sort"),
        (lambda: RelaxationTest([0.1, 1, 1], FALLING), "need increasing times"),
        (lambda: RelaxationTest([-1, 1, 2], FALLING), "`time` is .* need 0 or more"),
        (lambda: RelaxationTest(ROW, [3e5, -1.0, 2e5]), "`modulus` must be positive"),
        (lambda: RelaxationTest(ROW, [3e5, np.nan, 2e5]), "`modulus` must be positive"),
        (lambda: RelaxationTest(ROW, FALLING[:2]), r"shape \(2,\), need \(3\)"),
        (lambda: RelaxationTest(ROW, FALLING, noise=[0.1, 0.1]), "`noise` has shape"),
        (lambda: RelaxationTest(ROW, FALLING, noise=0.0), "`noise` must be positive"),
        (lambda: CreepTest(ROW, [0.0, 1e-6, 1e-6]), "`compliance` must be positive"),
        (lambda: DynamicTest(ROW, FALLING, [0.1, 0.1, 0.2]), "Multiply a loss factor"),
        (lambda: DynamicTest([0, 1, 2], FALLING, FALLING), "`frequency` must be positive"),
        (lambda: DynamicTest(ROW, FALLING, [3e4, -3e4, 3e4]), "`loss` must be positive"),
        (lambda: RingDown([4.35, 7.69], [5.5, 5.2]), "divide percent by 100"),
        (lambda: Prony([0.1, -0.1], [1.0, 2.0]), "shares"),
        (lambda: material.fit_spectrum([]), "got no test"),
        (lambda: material.fit_spectrum([GOOD], branches=2), "got 3 readings, need 5 for 2"),
        (lambda: material.fit_spectrum([GOOD], branches=0), "need 1 or more"),
        (
            lambda: material.fit_spectrum([RelaxationTest(ROW, [0.3, 0.24, 0.2])]),
            "need Pa, .*Multiply MPa by 1e6, kPa by 1e3",
        ),
        (
            lambda: material.fit_spectrum([RelaxationTest(ROW, [300.0, 240.0, 200.0])]),
            "largest modulus of RelaxationTest is 300.*`softest`",
        ),
        (
            lambda: material.fit_spectrum([CreepTest(ROW, [3e-3, 4e-3, 5e-3])]),
            "largest modulus of CreepTest is 333",
        ),
        (
            lambda: material.fit_spectrum([GOOD, CreepTest(ROW, [3e-9, 4e-9, 5e-9])]),
            "CreepTest has .* times the modulus of RelaxationTest",
        ),
        (
            lambda: material.fit_spectrum([RelaxationTest([1e9, 2e9, 1e10], FALLING)]),
            "Convert times to s, frequencies to Hz",
        ),
        (
            lambda: material.fit_spectrum([GOOD, RelaxationTest(ROW, FALLING, noise=0.1)]),
            "noise for 1 of 2 tests",
        ),
        (lambda: material.fit_spectrum([RelaxationTest([0.0], [2e5])]), "all .* at time 0"),
        (lambda: material.fit_spectrum([RelaxationTest(ROW, [2e5] * 3)]), "nothing relaxes"),
        (
            lambda: material.predicted_readings(GOOD, 2e5, Prony([np.ones(2)], [1.0])),
            "Take the spectrum of one material",
        ),
    ],
)
def test_bad_records_name_the_remedy(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_gel_below_the_limit_is_fitted_when_asked_for():
    soft = RelaxationTest(ROW, [300.0, 240.0, 200.0])
    assert material.fit_spectrum([soft], softest=10.0).modulus < 200.1
