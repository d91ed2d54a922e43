"""Viscoelastic solids: closed forms, dissipation, invariance, order, bodies, networks, cost."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import fem, material, mesh, systems as S
from sorojax.fem.assembly.assemble import assemble
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.fem.problem import body, exchanged, residual
from sorojax.fem.relaxation import after_step, in_step, moduli, relaxed
from sorojax.material import viscoelastic as V
from sorojax.material.kinematics import from_matrix
from sorojax.math.linalg import sparse

pytestmark = pytest.mark.quick

SHEAR = 3e5
RUBBER = material.NeoHookean(SHEAR, 3e6, 1000.0)
ONE = material.Prony([0.7], [0.1])
FIVE = material.Prony([0.5, 0.3, 0.2, 0.4, 0.1], [1e-3, 1e-2, 0.05, 0.3, 2.0])
SPECTRA = pytest.mark.parametrize("spectrum", [ONE, FIVE], ids=["one", "five"])


def shears(gamma):
    """Simple shears."""
    return jnp.zeros((gamma.shape[0], 3, 3)).at[:, 0, 1].set(gamma) + jnp.eye(3)[None]


def linear_stress(spectrum, times, gamma):
    """Shear stress over the long-time modulus of small shears `gamma`: the slope at rest."""
    solid = material.Viscoelastic(RUBBER, spectrum)

    def stress(size):
        return material.stress_history(solid, times, shears(size * gamma))[:, 0, 1]

    return jax.jvp(stress, (0.0,), (1.0,))[1] / SHEAR


def extrapolated(answer, steps):
    """What answers of second order in the step tend to, from `steps` and twice as many."""
    return (4 * answer(2 * steps)[::2] - answer(steps)) / 3


# ---- the material at a point


@SPECTRA
def test_a_held_strain_relaxes_as_the_spectrum_says(spectrum):
    """At a large strain too, in steps of any length."""
    times = jnp.array([0.0, 1e-16, 1e-4, 3e-3, 0.5, 0.51, 7.0])
    F = jnp.array([[1.4, 0.6, -0.2], [0.1, 0.9, 0.3], [0.2, -0.1, 0.8]])
    solid = material.Viscoelastic(material.MooneyRivlin(1e5, 0.5e5, 3e6), spectrum)
    history = jnp.stack([jnp.eye(3), *6 * [F]])
    found = material.stress_history(solid, times, history)[1:]
    slow = material.first_piola_kirchhoff_stress(solid, F)
    branch = material.NeoHookean(SHEAR, 1e-9)
    fast = material.first_piola_kirchhoff_stress(branch, F)
    share = material.relaxation_modulus(spectrum, times[1:]) - 1
    exact = slow[None] + share[:, None, None] * fast[None]
    assert float(jnp.abs(found - exact).max() / jnp.abs(exact).max()) < 1e-8


@SPECTRA
def test_small_vibrations_show_storage_and_loss_moduli(spectrum):
    omega, duration = 7.0, 0.9

    def stress(steps):
        t = jnp.linspace(0.0, duration, steps + 1)
        return linear_stress(spectrum, t, jnp.sin(omega * t))

    t = jnp.linspace(0.0, duration, 501)
    exact = material.storage_modulus(spectrum, omega) * jnp.sin(omega * t)
    exact = exact + material.loss_modulus(spectrum, omega) * jnp.cos(omega * t)
    for g, tau in zip(spectrum.shares, spectrum.times, strict=True):  # from the start at rest
        exact = exact - g * omega * tau / (1 + (omega * tau) ** 2) * jnp.exp(-t / tau)
    found = extrapolated(stress, 500)
    if spectrum is FIVE:  # steps longer than the shortest time have not reached their order
        found = extrapolated(stress, 8000)[::16]
    assert float(jnp.abs(found - exact).max() / jnp.abs(exact).max()) < 1e-8


def creep(spectrum, t):
    """Shear over that of slow loading under a stress that is put on at once."""
    g, tau = (np.array([float(x) for x in each]) for each in (spectrum.shares, spectrum.times))
    # e = (s + sum g_i a_i) / (1 + sum g_i), da_i/dt = (e - a_i) / tau_i
    total = 1 + g.sum()
    matrix = (g[None] / total - np.eye(len(g))) / tau[:, None]
    values, vectors = np.linalg.eig(matrix)
    steady = -np.linalg.solve(matrix, 1 / (tau * total))
    parts = np.linalg.solve(vectors, -steady)
    a = steady[:, None] + vectors @ (parts[:, None] * np.exp(values[:, None] * np.asarray(t)))
    return (1 + g @ a) / total


@SPECTRA
def test_the_creep_of_the_closed_form_keeps_the_stress(spectrum):
    def stress(steps):
        # quadratic: the steps at the start are short against every time
        t = jnp.concatenate([jnp.zeros(1), 1e-16 + jnp.linspace(0.0, 1.0, steps + 1) ** 3])
        gamma = jnp.concatenate([jnp.zeros(1), jnp.asarray(creep(spectrum, t[1:]))])
        return linear_stress(spectrum, t, gamma)[1:]

    found = extrapolated(stress, 500 if spectrum is ONE else 4000)
    assert float(jnp.abs(found - 1).max()) < 1e-8
    if spectrum is ONE:
        g, tau = 0.7, 0.1
        exact = 1 - g / (1 + g) * np.exp(-0.2 / (tau * (1 + g)))
        assert np.isclose(creep(spectrum, [0.2])[0], exact, rtol=1e-13)


def unimodular(key, count, size):
    H = size * jax.random.normal(key, (count, 3, 3))
    H = H - jnp.trace(H, axis1=1, axis2=2)[:, None, None] / 3 * jnp.eye(3)[None]
    return jax.vmap(jax.scipy.linalg.expm)(H)


def test_dissipation_is_never_negative(getkey):
    """On 1,000 random histories, steps from a thousandth to a thousand relaxation times."""
    spectrum, count = material.Prony([0.5, 0.3, 0.4], [0.01, 0.1, 1.0]), 12
    solid = material.Viscoelastic(RUBBER, spectrum)
    modulus = V.branch_moduli(solid)

    @jax.vmap
    def history(key):
        first, second, third = jax.random.split(key, 3)
        size = 10 ** jax.random.uniform(third, minval=-4.0, maxval=-0.3)
        F = unimodular(first, count, size)
        steps = 10 ** jax.random.uniform(second, (count,), minval=-3.0, maxval=1.0)

        def advance(rows, now):
            before = [tuple(row) for row in rows]
            new = V.relaxed_by(
                V.step_weights(spectrum, now[1]), before, V.inverse_strain(from_matrix(now[0]))
            )
            new = jnp.stack([jnp.stack(row) for row in new])
            mean = [tuple(row) for row in (rows + new) / 2]
            taken = V.dissipation(modulus, spectrum, mean) * now[1]
            held = V.dissipation(modulus, spectrum, [tuple(row) for row in new])
            return new, (taken, held)

        rest = jnp.stack(V.inverse_strain(from_matrix(jnp.eye(3))))
        _, found = jax.lax.scan(advance, jnp.stack([rest] * 4), (F, steps))
        return jnp.stack(found)

    found = history(jax.random.split(getkey(), 1000))
    rounding = 1e-13 * SHEAR / 0.01
    assert float(found.min()) > -rounding, float(found.min())


def test_the_dissipation_is_the_work_that_is_not_stored(getkey):
    """Along smooth random histories in short steps."""
    spectrum = material.Prony([0.5, 0.3], [0.05, 0.3])
    solid, steps = material.Viscoelastic(RUBBER, spectrum), 2000
    t = jnp.linspace(0.0, 1.0, steps + 1)
    H = 0.2 * jax.random.normal(getkey(), (3, 3, 3))
    waves = jnp.stack([jnp.sin(5 * t), 1 - jnp.cos(9 * t), jnp.sin(14 * t) ** 2])
    F = jnp.eye(3)[None] + 0.5 * jnp.einsum("kt,kij->tij", waves, H)
    P = material.stress_history(solid, t, F)
    work = jnp.sum((P[1:] + P[:-1]) / 2 * jnp.diff(F, axis=0))
    modulus = V.branch_moduli(solid)

    def advance(rows, F):
        before = [tuple(row) for row in rows]
        inverse = V.inverse_strain(from_matrix(F))
        new = V.relaxed_by(V.step_weights(spectrum, 1.0 / steps), before, inverse)
        new = jnp.stack([jnp.stack(row) for row in new])
        mean = [tuple(row) for row in (rows + new) / 2]
        return new, V.dissipation(modulus, spectrum, mean) / steps

    start = jnp.stack([jnp.stack(V.inverse_strain(from_matrix(F[0])))] * 3)
    rows, taken = jax.lax.scan(advance, start, F[1:])
    rows = [tuple(row) for row in rows]
    overstressed = V.Overstressed(RUBBER, jnp.stack(V.borne(modulus, rows)))
    stored = material.strain_energy_density(overstressed, from_matrix(F[-1]))
    stored = stored + V.free_energy(modulus, rows)
    stored = stored - material.strain_energy_density(RUBBER, from_matrix(F[0]))
    assert float(jnp.sum(taken)) > 0.1 * float(work)
    assert jnp.isclose(work, stored + jnp.sum(taken), rtol=1e-4)


@pytest.mark.parametrize(("invariant", "gives_back"), [(1, False), (2, True)])
def test_a_convolution_of_the_stress_may_give_energy_back(invariant, gives_back):
    """Why the branches are not Simo's: there and back between two near strains, relaxing at
    each, takes dC : dS / 2 of the stress S that is convolved. It is negative for the second
    invariant, and never for the first."""
    A = jnp.diag(jnp.array([0.1272, 0.8625, 1 / (0.1272 * 0.8625)]))

    def stress(C):
        inverse = jnp.linalg.inv(C)
        S = jnp.eye(3) if invariant == 1 else -inverse @ inverse
        return S - jnp.sum(S * C) / 3 * inverse

    slope = np.asarray(jax.jacfwd(stress)(A)).reshape(9, 9)
    pairs = [(i, j) for i in range(3) for j in range(i + 1)]
    units = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate(pairs):
        units[k, i, j] = units[k, j, i] = 1.0 if i == j else 0.5**0.5
    units = units.reshape(6, 9)
    normal = units @ np.linalg.inv(A).ravel()  # strains that keep the volume lie across it
    keeps = np.eye(6) - np.outer(normal, normal) / (normal @ normal)
    form = keeps @ units @ (slope + slope.T) @ units.T @ keeps
    least = np.linalg.eigvalsh(form)[0] / np.abs(form).max()
    assert (least < -1e-3) if gives_back else (least > -1e-12), least


def test_stress_turns_with_the_observer(getkey):
    t = jnp.linspace(0.0, 0.5, 20)
    H = 0.3 * jax.random.normal(getkey(), (20, 3, 3))
    F = jnp.eye(3)[None] + H * (t / t[-1])[:, None, None]
    spin = jnp.cross(jnp.eye(3), jnp.array([0.3, -0.8, 0.5])[None])
    Q = jax.vmap(lambda a: jax.scipy.linalg.expm(a * spin))(9 * t)
    solid = material.Viscoelastic(RUBBER, FIVE)
    seen = material.stress_history(solid, t, Q @ F)
    turned = Q @ material.stress_history(solid, t, F)
    assert float(jnp.abs(seen - turned).max() / jnp.abs(turned).max()) < 1e-12


def test_the_error_falls_with_the_square_of_the_step():
    solid = material.Viscoelastic(RUBBER, material.Prony([0.6, 0.4], [0.1, 0.5]))

    def stress(steps):
        t = jnp.linspace(0.0, 1.0, steps + 1)
        return material.stress_history(solid, t, shears(0.8 * jnp.sin(8 * t)))[-1, 0, 1]

    exact = extrapolated(lambda n: stress(n)[None], 1600)[0]
    coarse, fine = (abs(float(stress(n) - exact)) for n in (100, 200))
    assert 3.8 < coarse / fine < 4.2


def test_steps_ten_times_the_shortest_time_find_the_relaxed_answer():
    tau = 1e-3
    solid = material.Viscoelastic(RUBBER, material.Prony([2.0], [tau]))
    t = 10 * tau * jnp.arange(101.0)
    gamma = jnp.minimum(t, 50 * 10 * tau)  # to a shear of one half, then held
    found = material.stress_history(solid, t, shears(gamma))[:, 0, 1]
    slow = jax.vmap(lambda F: material.first_piola_kirchhoff_stress(RUBBER, F))(shears(gamma))
    error = jnp.abs(found / slow[:, 0, 1] - 1)
    assert float(error[30:].max()) < 0.01 and float(error[51:].max()) < 1e-5


def test_shares_of_the_instantaneous_modulus_are_converted():
    spectrum = material.prony_of_instantaneous([0.3, 0.2], [0.1, 1.0])
    assert np.allclose([float(g) for g in spectrum.shares], [0.6, 0.4])
    assert np.isclose(float(material.long_time_share(spectrum)), 0.5)
    assert np.isclose(float(material.relaxation_modulus(spectrum, 0.0)), 2.0)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: material.Prony([0.1, -0.2], [1.0, 2.0]), "shares"),
        (lambda: material.Prony([0.1, 0.2], [1.0, 0.0]), "times"),
        (lambda: material.Prony([0.1, 0.2], [2.0, 1.0]), "each longer than the one before"),
        (lambda: material.Prony([0.1, 0.2], [2.0]), "2 shares and 1 times"),
        (lambda: material.Prony([np.ones(3), np.ones(2)], [1.0, 2.0]), "shapes"),
        (lambda: material.prony_of_instantaneous([0.6, 0.5], [1.0, 2.0]), "less than 1"),
        (
            lambda: material.stress_history(
                material.Viscoelastic(RUBBER, ONE), jnp.zeros(2), jnp.zeros((3, 3, 3))
            ),
            "Give one matrix for each time",
        ),
        (
            lambda: problem(material.Scaled(material.Viscoelastic(RUBBER, ONE), 2.0)),
            "stands outermost",
        ),
    ],
)
def test_bad_numbers_name_the_remedy(make, says):
    with pytest.raises((ValueError, TypeError), match=says):
        make()


# ---- bodies


BAR = mesh.rectangle([5e-3, 0], [35e-3, 10e-3], divisions=(3, 1), element=mesh.Quad4())
SPACE = fem.space(BAR)
SILICONE = material.Viscoelastic(RUBBER, material.Prony([0.5, 0.3], [0.002, 0.02]))


def problem(rubber, grid=BAR, kinematics=None, **options):
    kinematics = fem.PlaneStrain(10e-3) if kinematics is None else kinematics
    force = fem.Force(grid.node_sets["right"], [0.0, -0.02], name="push")
    options = {"space": SPACE if grid is BAR else None, "loads": (force,), **options}
    fixed = (fem.Fixed(grid.node_sets["left"]),)
    return fem.problem(grid, rubber, kinematics=kinematics, supports=fixed, **options)


def grid_of(element, **options):
    return mesh.rectangle([5e-3, 0], [20e-3, 10e-3], divisions=(2, 1), element=element)


GRIDS = {
    "plane strain": lambda: (BAR, fem.PlaneStrain(10e-3)),
    "linear pressures": lambda: (grid_of(mesh.Quad9()), fem.PlaneStrain(10e-3)),
    "axisymmetric": lambda: (BAR, fem.Axisymmetric()),
    "plane stress": lambda: (BAR, fem.PlaneStress(10e-3)),
    "solid": lambda: (
        mesh.box([0, 0, 0], [2e-2, 1e-2, 1e-2], divisions=(2, 1, 1)),
        fem.Solid(),
    ),
}


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("law", ["closed form", "differentiated"])
def test_force_and_tangent_are_slopes_of_the_energy_of_a_step(name, law, getkey):
    grid, kinematics = GRIDS[name]()
    rubber = RUBBER if law == "closed form" else material.MooneyRivlin(1e5, 0.5e5, 3e6)
    cells = np.linspace(0.1, 0.5, grid.num_cells)
    solid = material.Viscoelastic(rubber, material.Prony([cells, 0.3 + 0 * cells], [0.01, 0.1]))
    given = body(problem(solid, grid, kinematics, loads=(), free=True))
    u, v, way = (3e-4 * jax.random.normal(getkey(), grid.points.shape) for _ in range(3))
    of = moduli(given)
    strains, taken = after_step(given, of, relaxed(given, u), jnp.asarray(0.02), v)
    now = exchanged(given, material=in_step(given, of, strains, jnp.asarray(0.01))[0])
    found = linearise(now, prepare(now), u, u)
    force, slope = jax.jvp(lambda u: residual(now, u), (u,), (way,))
    assert float(taken) > 0
    assert jnp.allclose(found.residual, force.ravel(), atol=1e-12 * float(jnp.abs(force).max()))
    product = sparse.product(given.space.system, found.values, way.ravel())
    assert jnp.allclose(product, slope.ravel(), atol=1e-11 * float(jnp.abs(slope).max()))


def times_and_push(count=12):
    times = jnp.concatenate([jnp.array([0.0, 1e-12]), jnp.linspace(1e-3, 0.5, count - 2)])
    push = jnp.zeros((count, 2)).at[1:, 1].set(-0.02)
    return times, push


@pytest.mark.parametrize("kinematics", [fem.PlaneStrain(10e-3), fem.PlaneStress(10e-3)])
def test_a_body_creeps_from_the_stiff_to_the_slow_answer(kinematics):
    """The instantaneous answer is that of the sum of all moduli; forces balance on the way."""
    times, push = times_and_push()
    path = fem.solve_path(problem(SILICONE, kinematics=kinematics), times=times, push=push)
    down = path.displacements[:, :, 1].min(axis=1)
    stiff = material.NeoHookean(1.8 * SHEAR, 3e6)
    fast, slow = (
        fem.solve(problem(rubber, kinematics=kinematics)).displacement[:, 1].min()
        for rubber in (stiff, RUBBER)
    )
    assert jnp.isclose(down[1], fast, rtol=1e-9) and jnp.isclose(down[-1], slow, rtol=1e-6)
    assert bool(jnp.all(jnp.diff(down) <= 0)) and abs(float(down[0])) < 1e-15
    held = path.problem_at(5)
    force = residual(held, path.displacements[5])[np.asarray(BAR.points[:, 0]) > 6e-3]
    assert float(jnp.abs(force).max()) < 1e-9


def test_a_cell_is_a_point_of_the_material():
    """Simple shear, whose reactions are P times the area."""
    grid = mesh.rectangle([0, 0], [1e-2, 1e-2], divisions=(1, 1), element=mesh.Quad4())
    times = jnp.array([0.0, 0.01, 0.02, 0.1, 0.3])
    gammas = jnp.array([0.0, 0.3, 0.5, 0.2, 0.2])
    solid = material.Viscoelastic(RUBBER, FIVE)
    exact = material.stress_history(solid, times, shears(gammas))[:, 0, 1]
    given = body(problem(solid, grid, fem.PlaneStrain(1e-2), loads=(), free=True))
    X, of, found = grid.points, moduli(given), [0.0]
    strains = relaxed(given, 0 * X)
    for step, gamma in zip(jnp.diff(times), gammas[1:], strict=True):
        u = jnp.stack([gamma * X[:, 1], 0 * X[:, 1]], axis=1)
        now = exchanged(given, material=in_step(given, of, strains, step)[0])
        force = residual(now, u)
        found.append(float(jnp.sum(jnp.where(X[:, 1] > 5e-3, force[:, 0], 0.0))) / 1e-4)
        strains, _ = after_step(given, of, strains, step, u)
    assert np.allclose(found, exact, rtol=1e-10)


MOTION = {"duration": 0.02, "step": 5e-4}


@functools.cache
def swing(step=5e-4):
    start = fem.solve(problem(SILICONE)).displacement
    free = problem(SILICONE, loads=())
    return fem.simulate(free, 0.02, step, start=(start, 0 * start))


def test_a_motion_keeps_its_energy_but_for_what_the_branches_take():
    left = []
    for step in (5e-4, 2.5e-4):
        energies = swing(step).energies
        left.append(float(jnp.abs(energies.balance - energies.balance[0]).max()))
    assert float(energies.dissipated[-1]) > 0.3 * float(energies.elastic[0])
    assert bool(jnp.all(jnp.diff(energies.dissipated) >= 0))
    assert left[1] < 0.02 * float(energies.elastic[0]) and left[0] > 2.5 * left[1], left


def test_a_run_in_two_parts_has_the_bits_of_the_whole():
    free, whole = swing().problem, swing()
    start = whole.displacements[0]
    first = fem.simulate(free, 0.01, 5e-4, start=(start, 0 * start))
    second = fem.simulate(free, 0.01, 5e-4, start=first)
    assert jnp.array_equal(second.end.displacement, whole.end.displacement)
    assert jnp.array_equal(second.end.strains, whole.end.strains)
    with pytest.raises(ValueError, match="viscoelastic"):
        fem.simulate(problem(RUBBER, loads=()), 0.01, 5e-4, start=first)


def test_a_motion_in_a_trace_is_that_of_the_host():
    free, start = swing().problem, swing().displacements[0]

    def end(scale):
        rubber = material.Viscoelastic(RUBBER, material.Prony([scale, 0.3], [0.002, 0.02]))
        given = dataclasses.replace(free, material=rubber)
        return fem.simulate(given, 2e-3, 5e-4, start=(start, 0 * start)).displacements[-1]

    scales = jnp.array([0.5, 0.9])
    alone = jnp.stack([end(scale) for scale in scales])
    for found in (jax.jit(jax.vmap(end))(scales), jax.vmap(end)(scales)):
        assert float(jnp.abs(found - alone).max() / jnp.abs(alone).max()) < 1e-9


def test_gradients_by_every_constant_through_200_steps():
    """Modulus, bulk modulus, shares and times, against differences of fourth order."""
    grid = mesh.rectangle([0, 0], [3e-2, 1e-2], divisions=(2, 1), element=mesh.Quad4())
    free = problem(SILICONE, grid, loads=(fem.Gravity([2000.0, -300.0]),))
    newton = fem.Newton(residual_tolerance=1e-13, step_tolerance=1e-10)

    def way(theta):
        rubber = material.NeoHookean(theta[0] * SHEAR, theta[1] * 3e6, 1000.0)
        solid = material.Viscoelastic(
            rubber, material.Prony(0.5 * theta[2:4], 0.01 * theta[4:6])
        )
        given = dataclasses.replace(free, material=solid)
        motion = fem.simulate(given, 0.1, 5e-4, newton=newton, save=2)
        return 1e3 * motion.displacements[-1].mean() + 1e2 * motion.end.dissipated

    theta = jnp.array([1.0, 1.0, 1.0, 0.6, 0.3, 2.0])
    slope = np.asarray(jax.grad(way)(theta))
    for k in range(6):
        d = jnp.zeros(6).at[k].set(2e-3 * float(theta[k]))
        change = [float(way(theta + n * d) - way(theta - n * d)) for n in (1, 2)]
        assert np.isclose(slope[k], (8 * change[0] - change[1]) / (12 * d[k]), rtol=1e-6)


def test_without_branches_nothing_is_added():
    """At rest a viscoelastic body is its base, and its program has the same equations."""

    def count(rubber):
        given = exchanged(body(problem(SILICONE)), material=rubber)
        shape, u = prepare(given).geometry, jnp.zeros_like(BAR.points)

        def run(u):
            return tuple(assemble(given.space, shape, rubber, given.kinematics, u, u))

        return equations(jax.make_jaxpr(run)(u).jaxpr)

    def equations(jaxpr):
        inner = [x for e in jaxpr.eqns for x in jax.tree.leaves(list(e.params.values()))]
        inner = [getattr(x, "jaxpr", x) for x in inner]
        return len(jaxpr.eqns) + sum(equations(x) for x in inner if hasattr(x, "eqns"))

    assert count(SILICONE) == count(RUBBER) < count(overstressed())


def overstressed():
    given = body(problem(SILICONE))
    strains = relaxed(given, jnp.zeros_like(BAR.points))
    return in_step(given, moduli(given), strains, jnp.asarray(1e-3))[0]


def test_a_body_in_a_network_moves_as_its_differential_equations_say():
    grid = mesh.rectangle([5e-3, 0], [8e-3, 4e-3], divisions=(1, 1), element=mesh.Quad4())
    ends = tuple(fem.Fixed(grid.node_sets[side], (1,)) for side in ("bottom", "top"))
    rubber = material.Viscoelastic(RUBBER, material.Prony([0.5, 0.3], [1e-4, 1e-3]))
    given = fem.problem(
        grid,
        rubber,
        kinematics=fem.Axisymmetric(),
        supports=ends,
        loads=(fem.Pressure(grid.facet_sets["left"]),),
    )
    v = jnp.zeros_like(grid.points).at[:, 0].set(2.0)
    tube = S.FemBody(given, v=v, markers={"skin": 0}, energies=True)
    wires = {
        "tube.pressure": "air.pressure",
        "air.volume": "tube.volume",
        "air.volume_rate": "tube.volume_rate",
    }
    network = S.Network({"tube": tube, "air": S.Reservoir(start_pressure=1e3)}, wires)
    exact = S.simulate(network, 4e-4, save=2, rtol=1e-8, atol=1e-11)
    errors = []
    for steps in (160, 320):
        film = S.simulate(network, 4e-4, step=4e-4 / steps, save=2)
        for port in ("tube.skin_position", "tube.dissipated"):
            missed = float(jnp.abs(film[port][-1] - exact[port][-1]).max())
            errors.append(missed / float(jnp.abs(exact[port][-1] - exact[port][0]).max()))
    assert max(errors[2:]) < 1e-3, errors
    assert errors[0] > 3 * errors[2] and errors[1] > 3 * errors[3], errors
