"""Rubbers that soften: closed forms, loops, invariance, derivatives, bodies, networks, fits, cost."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erf

from sorojax import fem, material, mesh, systems as S
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.fem.problem import body, exchanged, residual
from sorojax.fem.relaxation import (
    after_step,
    first_peaks,
    in_step,
    moduli,
    raised_peaks,
    relaxed,
)
from sorojax.material.kinematics import from_matrix
from sorojax.material.softening.law import with_peak
from sorojax.math.linalg import sparse
from tests.test_viscoelastic import BAR, GRIDS, problem, shears, unimodular

BULK = 3e6
RUBBER = material.NeoHookean(3e5, BULK, 1000.0)
LAWS = {
    "closed form": RUBBER,
    "two invariants": material.MooneyRivlin(1e5, 0.5e5, BULK, 1000.0),
    "principal stretches": material.Ogden((3e5, -1e5), (2.0, -2.0), BULK, 1000.0),
    "grown": material.Grown(RUBBER, [1.1, 1.0, 0.9]),
}
CONSTANTS = {"r": 1.8, "m": 2e4, "beta": 0.2}
SOFT = material.Softening(RUBBER, **CONSTANTS)
MILD = material.Softening(RUBBER, r=1.8, m=2e2, beta=0.2)  # for small strains
SILICONE = material.Viscoelastic(MILD, material.Prony([0.5, 0.3], [0.002, 0.02]))


def isochoric(law, F):
    return law.isochoric_energy(from_matrix(F))


def share(W, peak, r=1.8, m=2e4, beta=0.2):
    """eta by its formula."""
    return 1 - erf(np.maximum(peak - W, 0.0) / (m + beta * peak)) / r


# ---- the material at a point


@pytest.mark.parametrize("name", LAWS)
def test_stress_is_that_of_the_first_loading_times_its_share(name, getkey):
    law = LAWS[name]
    F = unimodular(getkey(), 30, 0.3) * 1.02
    found = material.stress_history(material.Softening(law, **CONSTANTS), None, F)
    W = np.asarray(jax.vmap(lambda F: isochoric(law, F))(F))
    shape = jax.vmap(jax.grad(lambda F: isochoric(law, F)))(F)
    whole = jax.vmap(lambda F: material.first_piola_kirchhoff_stress(law, F))(F)
    eta = share(W, np.maximum.accumulate(W))
    assert eta.min() < 0.7 and eta[0] == 1.0
    exact = whole + jnp.asarray(eta - 1)[:, None, None] * shape
    assert float(jnp.abs(found - exact).max() / jnp.abs(exact).max()) < 1e-13


def test_energies_are_integrals_of_the_share():
    """What comes back from the peak, and what does not, by quadrature."""
    peak = 1.3e5
    W = np.linspace(0.0, peak, 20001)
    back = np.trapezoid(share(W, peak), W)
    held = with_peak(SOFT, jnp.asarray(peak))
    F = jnp.diag(jnp.array([2.0, 2.0**-0.5, 2.0**-0.5]))
    scaled = dataclasses.replace(held, base=material.NeoHookean(peak, BULK))  # I1 - 3 is 2
    assert np.isclose(isochoric(scaled, F), back, rtol=1e-8)
    assert np.isclose(material.dissipated_energy(SOFT, peak), peak - back, rtol=1e-8)


def closed_loops(key, steps):
    """Ways from rest and back to it, of very different sizes."""
    t = jnp.linspace(0.0, 1.0, steps + 1)
    waves = jnp.stack([jnp.sin(jnp.pi * n * t) for n in (1, 2, 3)])

    @jax.vmap
    def one(key):
        first, second = jax.random.split(key)
        H = jax.random.normal(first, (3, 3, 3)) * 10 ** jax.random.uniform(
            second, minval=-2.0, maxval=-0.3
        )
        H = H - jnp.trace(H, axis1=1, axis2=2)[:, None, None] / 3 * jnp.eye(3)[None]
        return jax.vmap(jax.scipy.linalg.expm)(jnp.einsum("kt,kij->tij", waves, H))

    return one(jax.random.split(key, 1000))


def test_loops_never_give_energy(getkey):
    """On 1,000 random loops, gone round twice: the work of the first is what turns into heat,
    that of the second is none."""
    F = closed_loops(getkey(), 600)

    @jax.jit
    @jax.vmap
    def works(F):
        P = material.stress_history(SOFT, None, jnp.concatenate([F, F]))
        pull, rise = jnp.split(P, 2), jnp.diff(F, axis=0)
        peak = jax.vmap(lambda F: isochoric(RUBBER, F))(F).max()
        return jnp.stack([jnp.sum((p[1:] + p[:-1]) / 2 * rise) for p in pull]), peak

    work, peak = works(F)
    heat = material.dissipated_energy(SOFT, peak)
    scale = heat + 1e-3 * peak
    assert float(peak.max() / peak.min()) > 1e3
    assert float(jnp.abs((work[:, 0] - heat) / scale).max()) < 0.02
    assert float(jnp.abs(work[:, 1] / scale).max()) < 0.02
    assert float((work[:, 0] / scale).min()) > 0


def test_stress_turns_with_the_observer(getkey):
    F = unimodular(getkey(), 20, 0.3)
    spin = jnp.cross(jnp.eye(3), jnp.array([0.3, -0.8, 0.5])[None])
    Q = jax.vmap(lambda a: jax.scipy.linalg.expm(a * spin))(jnp.linspace(0.0, 4.0, 20))
    seen = material.stress_history(SOFT, None, Q @ F)
    turned = Q @ material.stress_history(SOFT, None, F)
    assert float(jnp.abs(seen - turned).max() / jnp.abs(turned).max()) < 1e-12


def test_stress_is_continuous_at_the_peak_and_stiffer_below_it():
    def stress(gamma):
        F = shears(jnp.stack([jnp.asarray(0.5), gamma]))
        return material.stress_history(SOFT, None, F)[1, 0, 1]

    near = 1e-7
    below, at, above = (float(stress(jnp.asarray(0.5 + d))) for d in (-near, 0.0, near))
    slopes = [float(jax.grad(stress)(jnp.asarray(0.5 + d))) for d in (-near, near)]
    assert np.isclose(at, 0.5 * 3e5, rtol=1e-12)
    assert np.isclose(below, at, rtol=1e-6) and np.isclose(above, at, rtol=1e-6)
    W = 3e5 / 2 * 0.25
    more = 2 / np.sqrt(np.pi) / (1.8 * (2e4 + 0.2 * W)) * (3e5 * 0.5) ** 2
    assert np.isclose(slopes[1], 3e5, rtol=1e-6)
    assert np.isclose(slopes[0], 3e5 + more, rtol=1e-5)


def test_slopes_by_every_constant_and_by_the_deformation():
    """First loading, back, again to the peak and beyond, and a peak that is held."""
    gamma = jnp.array([0.0, 0.4, 0.1, 0.3, 0.4, 0.6, 0.6, 0.2, -0.5, 0.0])

    def stress(theta, gamma):
        law = material.Gent(3e5 * theta[0], 20.0 * theta[1], BULK * theta[2])
        soft = material.Softening(law, 1.8 * theta[3], 2e4 * theta[4], 0.2 * theta[5])
        return material.stress_history(soft, None, shears(gamma))[:, 0, 1] / 1e5

    held = jnp.zeros(10).at[jnp.array([1, 4])].set(1.0).at[jnp.array([5, 6])].set(1.0)
    ways = [(jnp.eye(6)[k], jnp.zeros(10)) for k in range(6)] + [(jnp.zeros(6), held)]
    at = jnp.ones(6), gamma
    run = jax.jit(lambda s, way: stress(at[0] + s * way[0], at[1] + s * way[1]))
    weights = jnp.linspace(-1.0, 2.0, 10)
    back = jax.jit(jax.grad(lambda *at: weights @ stress(*at), (0, 1)))(*at)
    for way in ways:
        ahead = jax.jvp(lambda s, way=way: run(s, way), (0.0,), (1.0,))[1]
        h = 1e-3
        one, two = (run(n * h, way) - run(-n * h, way) for n in (1, 2))
        size = float(jnp.abs(ahead).max()) + 1e-9
        assert float(jnp.abs(ahead - (8 * one - two) / (12 * h)).max()) < 1e-6 * size
        pulled = sum(float(jnp.sum(b * w)) for b, w in zip(back, way, strict=True))
        assert np.isclose(pulled, float(weights @ ahead), rtol=1e-10)


def test_branches_stand_beside_a_base_that_softens(getkey):
    times, F = jnp.linspace(0.0, 0.3, 15), unimodular(getkey(), 15, 0.3)
    spectrum = material.Prony([0.5, 0.3], [0.05, 0.3])
    found = material.stress_history(material.Viscoelastic(SOFT, spectrum), times, F)
    more = material.stress_history(material.Viscoelastic(RUBBER, spectrum), times, F)
    plain = jax.vmap(lambda F: material.first_piola_kirchhoff_stress(RUBBER, F))(F)
    exact = more - plain + material.stress_history(SOFT, None, F)
    assert float(jnp.abs(found - exact).max() / jnp.abs(exact).max()) < 1e-12


def test_a_preconditioned_rubber_is_elastic_and_softer_below_its_stretch():
    soft = material.preconditioned(SOFT, stretch=2.0)
    stretch = jnp.array([0.7, 1.0, 1.5, 2.0, 2.5])
    shares = np.asarray(
        material.uniaxial_stress(soft, stretch) / material.uniaxial_stress(RUBBER, stretch)
    )
    assert np.all(shares[[0, 2]] < 0.75) and np.allclose(shares[3:], 1.0, rtol=1e-9)
    by_energy = material.preconditioned(SOFT, energy=soft.peak)
    assert float(by_energy.peak) == float(soft.peak) and not soft.remembers
    F = jnp.diag(jnp.array([3.0, 0.6, 0.6]))
    history = jnp.stack([jnp.eye(3), F, jnp.diag(jnp.array([1.5, 0.8, 0.8]))])
    alone = material.first_piola_kirchhoff_stress(soft, history[2])
    assert jnp.array_equal(material.stress_history(soft, None, history)[2], alone)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: material.Softening(RUBBER, 1.0, 1e4), "`r` is 1.0, need more than 1"),
        (lambda: material.Softening(RUBBER, 2.0, 0.0), "`m` must be positive"),
        (lambda: material.Softening(RUBBER, 2.0, 1e4, -0.1), "`beta` is -0.1"),
        (lambda: material.Softening(RUBBER, 2.0, 1e4, peak=-1.0), "`peak` is -1"),
        (lambda: material.Softening(RUBBER, np.full(3, 2.0), np.ones(2)), "shapes"),
        (
            lambda: material.Softening(material.CompressibleNeoHookean(1e5, 1e6), 2.0, 1e4),
            "stressed there",
        ),
        (lambda: material.preconditioned(SOFT), "need one. Write"),
        (lambda: material.preconditioned(SOFT, stretch=2.0, energy=1.0), "need one. Write"),
        (lambda: material.preconditioned(SOFT, stretch=-1.0), "must be positive"),
        (lambda: material.stress_history(SOFT, None, jnp.eye(3)), "of shape .steps, 3, 3"),
        (lambda: material.stress_history(SILICONE, None, jnp.eye(3)[None]), "got no times"),
        (lambda: problem(material.Scaled(SOFT, 2.0)), "a Softening within a Scaled"),
        (
            lambda: problem(
                material.Softening(
                    material.Viscoelastic(RUBBER, material.Prony([0.3], [1.0])), 2.0, 1e4
                )
            ),
            "a Viscoelastic within a Softening",
        ),
    ],
)
def test_bad_numbers_name_the_remedy(make, says):
    with pytest.raises((ValueError, TypeError), match=says):
        make()


# ---- bodies


@pytest.mark.parametrize(
    ("name", "law"),
    [*((name, "closed form") for name in GRIDS), ("plane strain", "two invariants")],
)
def test_force_and_tangent_are_slopes_of_the_energy_of_a_step(name, law, getkey):
    grid, kinematics = GRIDS[name]()
    cells = np.linspace(1e2, 4e2, grid.num_cells)
    soft = material.Softening(LAWS[law], 1.8, cells, 0.2)
    given = body(problem(soft, grid, kinematics, loads=(), free=True))
    u, v, way = (3e-4 * jax.random.normal(getkey(), grid.points.shape) for _ in range(3))
    peaks = first_peaks(given, u)
    peaks, taken = raised_peaks(given, None, None, None, v, peaks)
    now = exchanged(given, material=in_step(given, None, None, None, peaks)[0])
    for at in (v + 1e-5 * way, 0.4 * v):
        found = linearise(now, prepare(now), at, at)
        force, slope = jax.jvp(lambda u: residual(now, u), (at,), (way,))
        big = float(jnp.abs(force).max())
        assert jnp.allclose(found.residual, force.ravel(), atol=1e-12 * big)
        product = sparse.product(given.space.system, found.values, way.ravel())
        size = float(jnp.abs(slope).max())
        assert jnp.allclose(product, slope.ravel(), atol=1e-11 * size)
    assert float(taken) > 0


PUSH = jnp.array([0.5, 1.0, 0.5, 0.0, 0.5, 1.0, 1.5, 0.7])


def pushed(rubber, kinematics=None, shares=PUSH, **options):
    row = shares[:, None] * jnp.array([[20.0, -2.0]])
    return fem.solve_path(problem(rubber, kinematics=kinematics), push=row, **options)


@pytest.mark.parametrize("kinematics", [fem.PlaneStrain(1e-2), fem.PlaneStress(1e-2)])
def test_a_path_goes_back_softer_and_again_the_same_way(kinematics):
    path = pushed(SOFT, kinematics)
    right = path.displacements[:, BAR.node_sets["right"][0], 0]
    assert float(right[2]) > 1.1 * float(right[0])  # half the force, after the whole
    assert np.allclose(right[4:6], right[jnp.array([2, 1])], rtol=1e-8)  # loaded again
    assert abs(float(right[3])) < 1e-9 and float(right[6]) > float(right[1])
    assert bool(jnp.all(jnp.diff(path.peaks, axis=0) >= 0))
    alone = fem.solve(dataclasses.replace(path.problem, loads=path.problem_at(1).loads))
    assert jnp.allclose(alone.displacement, path.displacements[1], atol=1e-12)
    for k in (2, 5, 7):
        force = residual(path.problem_at(k), path.displacements[k])
        assert float(jnp.abs(force[np.asarray(BAR.points[:, 0]) > 6e-3]).max()) < 1e-9


def test_a_path_in_a_trace_is_that_of_the_host_and_goes_on_where_it_ended():
    path = pushed(SOFT)
    traced = jax.jit(lambda m: pushed(material.Softening(RUBBER, 1.8, m, 0.2)))(2e4)
    assert jnp.allclose(traced.displacements, path.displacements, atol=1e-13)
    assert jnp.allclose(traced.peaks, path.peaks, rtol=1e-10)
    half = fem.solve_path(path.problem, push=path.values[:4])
    rest = fem.solve_path(half.problem_at(3), push=path.values[4:])
    assert jnp.allclose(rest.displacements, path.displacements[4:], atol=1e-13)
    assert jnp.array_equal(half.problem_at(3).material.peak, half.peaks[3])


def test_slopes_of_a_path_by_every_constant():
    def end(theta):
        law = material.NeoHookean(3e5 * theta[0], BULK * theta[1])
        soft = material.Softening(law, 1.8 * theta[2], 2e4 * theta[3], 0.2 * theta[4])
        newton = fem.Newton(residual_tolerance=1e-13, step_tolerance=1e-11)
        u = pushed(soft, shares=PUSH + 0.1, newton=newton).displacements
        return 1e3 * jnp.sum(u[:, -1] * jnp.arange(1.0, 9.0)[:, None])

    one = jnp.ones(5)
    slope = np.asarray(jax.grad(end)(one))
    for k in range(5):
        d = jnp.zeros(5).at[k].set(1e-3)
        change = [float(end(one + n * d) - end(one - n * d)) for n in (1, 2)]
        assert np.isclose(slope[k], (8 * change[0] - change[1]) / 12e-3, rtol=1e-6)


@pytest.mark.parametrize("relaxes", [False, True])
def test_a_cell_is_a_point_of_the_material(relaxes):
    """Simple shear, whose reactions are P times the area, also with branches."""
    grid = mesh.rectangle([0, 0], [1e-2, 1e-2], divisions=(1, 1), element=mesh.Quad4())
    times, gammas = jnp.array([0.0, 0.01, 0.02, 0.1]), jnp.array([0.0, 0.5, 0.3, 0.6])
    law = material.Viscoelastic(SOFT, SILICONE.relaxation) if relaxes else SOFT
    exact = material.stress_history(law, times, shears(gammas))[1:, 0, 1]
    X, top = grid.points, grid.node_sets["top"]
    supports = (
        fem.Fixed(grid.node_sets["bottom"]),
        fem.Prescribed(top, jnp.stack([0.0 * X[top, 0], 0.0 * X[top, 1]], axis=1)),
    )
    given = body(fem.problem(grid, law, kinematics=fem.PlaneStrain(1e-2), supports=supports))
    of, strains = moduli(given), relaxed(given, 0 * X)
    peaks, found = first_peaks(given, 0 * X), []
    for step, gamma in zip(jnp.diff(times), gammas[1:], strict=True):
        u = jnp.stack([gamma * X[:, 1], 0 * X[:, 1]], axis=1)
        now = exchanged(given, material=in_step(given, of, strains, step, peaks)[0])
        force = residual(now, u)
        found.append(float(jnp.sum(jnp.where(X[:, 1] > 5e-3, force[:, 0], 0.0))) / 1e-4)
        args = given, of, strains, step, u, peaks
        strains, peaks = after_step(*args)[0], raised_peaks(*args)[0]
    assert np.allclose(found, exact, rtol=1e-10)


def test_a_preconditioned_body_is_solved_as_an_elastic_one():
    soft = material.preconditioned(SOFT, energy=1e5)
    path, first = pushed(soft), pushed(RUBBER)
    assert path.peaks is None
    assert float(path.displacements[0, -1, 0]) > 1.2 * float(first.displacements[0, -1, 0])
    alone = fem.solve(dataclasses.replace(path.problem, loads=path.problem_at(4).loads))
    assert jnp.allclose(alone.displacement, path.displacements[0], atol=1e-12)


def test_without_softening_nothing_is_added():
    """A rubber as made is its base until something is remembered: the same equations."""

    def text(rubber):
        given = exchanged(body(problem(RUBBER)), material=rubber)
        return jax.jit(lambda u: residual(given, u)).lower(jnp.zeros_like(BAR.points)).as_text()

    assert text(SOFT) == text(RUBBER) != text(with_peak(SOFT, jnp.asarray(1e4)))


# ---- motions and networks


SWINGING = {"softening": MILD, "relaxing too": SILICONE}


@functools.cache
def swing(name, step=5e-4):
    law = SWINGING[name]
    push = fem.Force(BAR.node_sets["right"], [0.2, -0.1])
    start = fem.solve(problem(law, loads=(push,))).displacement
    return fem.simulate(problem(law, loads=()), 0.02, step, start=(start, 0 * start))


@pytest.mark.parametrize("name", SWINGING)
def test_a_motion_keeps_its_energy_but_for_what_turns_into_heat(name):
    left = []
    for step in (5e-4, 2.5e-4):
        energies = swing(name, step).energies
        left.append(float(jnp.abs(energies.balance - energies.balance[0]).max()))
    assert float(jnp.diff(energies.dissipated).min()) > -1e-12 * float(energies.elastic[0])
    assert float(energies.dissipated[-1]) > 1e-3 * float(energies.elastic[0])
    assert left[1] < 0.03 * float(energies.elastic[0]) and left[0] > 1.8 * left[1], left
