"""Every example runs and gives its number; the README's program is one of them."""

import re

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sorojax as sj
from benchmarks.cases import robots_arm
from tests.scripts import ROOT, main_of, user_code


def test_drawing_to_loop_reaches_its_target():
    numbers = main_of("01_drawing_to_loop")(quick=True)
    assert numbers["angle at the end [deg]"] == pytest.approx(-25, abs=0.2)
    assert numbers["stiffness misfit"] < 0.01
    assert 2 < numbers["pressure at the end [kPa]"] < 4


def test_a_tendon_finger_closes_on_a_ball():
    numbers = main_of("02_tendon_finger")()
    bent, pull = numbers["tip angle at 0.2 N [deg]"], numbers["pull for 150 deg [N]"]
    assert numbers["by tension [deg/N]"] == pytest.approx(bent / 0.2, rel=0.01)
    assert pull == pytest.approx(0.2 * 150 / bent, rel=0.01)
    assert 80 < numbers["tip angle around the ball [deg]"] < 110
    assert 0 < numbers["overlap over thickness [%]"] < 0.5


@pytest.mark.slow
def test_a_finger_and_its_tensions_are_better_found_together():
    main = main_of("32_codesign_tendon")
    numbers = main(quick=True)
    ways = ("start", "body alone", "in turn", "together")
    costs = [numbers[f"{way}: median cost [mm^2]"] for way in ways]
    assert costs == sorted(costs, reverse=True)
    assert numbers["better together"] == 2
    assert numbers["motions that ended well"] == 8
    _check_slopes(main.__globals__["total"])
    assert user_code("32_codesign_tendon") <= 60


def _check_slopes(total):
    """Along one direction of the bodies, and along one of the tensions."""
    random = np.random.default_rng(0)
    shapes = {"radii": (2, 2), "places": (2, 2, 2, 2), "pull": (2, 6, 2)}
    design = {k: jnp.asarray(random.uniform(0.2, 0.8, shape)) for k, shape in shapes.items()}
    way = {k: jnp.asarray(random.normal(size=shape)) for k, shape in shapes.items()}
    seen = []  # by the program that the example has compiled already
    sj.design.minimise(
        total, design, steps=1, change_gradient=lambda _, slope: seen.append(slope) or slope
    )
    for part in (("radii", "places"), ("pull",)):
        ahead, behind = (
            total({k: x + h * way[k] * float(k in part) for k, x in design.items()})
            for h in (1e-5, -1e-5)
        )
        slope = sum(jnp.sum(seen[0][k] * way[k]) for k in part)
        assert float(slope) == pytest.approx(float(ahead - behind) / 2e-5, rel=1e-6)


@pytest.mark.slow
def test_a_bellows_actuator_and_its_gains_are_found_together():
    """From the drawing to the loop; slopes of the body and of the gains beside differences."""
    main = main_of("30_codesign_bellows")
    numbers = main(quick=True)
    for way in ("in turn", "together"):
        assert 0 < numbers[f"{way} [deg rms]"] < 0.95 * numbers["start [deg rms]"]
    script = main.__globals__
    middle = jnp.full(8, 0.5)
    problem = script["problem_of"](script["robot_of"](middle), 2.6e-3)
    near = script["run"](problem, middle)

    def of(shares):
        return script["error"](script["run"](problem, shares, near))

    shares = jnp.linspace(0.3, 0.7, 8)
    slope = jax.grad(of)(shares)
    for way in np.eye(8).reshape(2, 4, 8).sum(axis=1):
        ahead, behind = (of(shares + h * way) for h in (1e-4, -1e-4))
        assert float(slope @ way) == pytest.approx(float(ahead - behind) / 2e-4, rel=1e-4)
    assert user_code("30_codesign_bellows") <= 60


@pytest.mark.slow
def test_a_tube_wound_with_fibres_twists_as_the_exact_solution_says():
    numbers = main_of("41_fibre_tube")(quick=True)
    assert numbers["largest error over the largest twist"] < 0.025
    slope = numbers["twist by winding angle at 30 deg [deg/deg]"]
    assert slope == pytest.approx(numbers["the same of a long tube [deg/deg]"], rel=0.02)
    assert user_code("41_fibre_tube") <= 60


def test_the_readme_says_how_programs_are_kept_for_the_next_run():
    assert "sj.enable_compilation_cache()" in (ROOT / "README.md").read_text()


def test_the_program_of_the_readme_prints_what_it_says(capsys):
    (program,) = re.findall(
        r"```python\n(import jax;.*?)```", (ROOT / "README.md").read_text(), re.S
    )
    exec(compile(program, "README.md", "exec"), {})
    height, slope = re.findall(r"Array\(([-+.\de]+)", capsys.readouterr().out)
    said = re.search(r"# (-[\d.]+) mm, \+([\d.]+) mm per mm", program)
    assert said is not None
    assert float(height) * 1e3 == pytest.approx(float(said[1]), abs=0.05)
    assert float(slope) == pytest.approx(float(said[2]), rel=0.02)
    assert len([line for line in program.splitlines() if line.strip()]) <= 15


def test_a_bench_on_a_desk_follows_its_target():
    pytest.importorskip("cv2")
    numbers = main_of("03_bench_on_a_desk")(quick=True)
    assert numbers["estimate off the true tip [mm rms]"] < 0.5
    assert numbers["tip off its target [mm rms]"] < 3
    assert numbers["pictures used"] == 75


@pytest.mark.slow
def test_three_solvers_and_three_adjoints_of_diffrax_give_one_derivative():
    """Explicit and implicit, in reverse by checkpoints and backwards in time, and forward."""
    numbers = main_of("05_diffrax")()
    assert len(numbers) == 5
    bent = main_of("05_diffrax").__globals__["bent"]
    solver, adjoint = dfx.Tsit5(), dfx.RecursiveCheckpointAdjoint()
    ends = [float(bent(jnp.asarray(e), solver, adjoint)) for e in (0.999e6, 1.001e6)]
    difference = (ends[1] - ends[0]) / 2e3 * 1e5
    assert list(numbers.values()) == pytest.approx(5 * [difference], rel=1e-5)


def test_the_example_with_diffrax_is_short_and_the_readme_names_it():
    assert user_code("05_diffrax") <= 45
    assert "examples/05_diffrax.py" in (ROOT / "README.md").read_text()


@pytest.mark.slow
def test_a_finger_and_its_controller_are_designed_together():
    """Every number of the design, through drawing, modes, contact and loop, has its slope."""
    main = main_of("31_codesign_gripper")
    numbers, names = main(quick=True), main.__globals__
    assert numbers["limits missed by [%]"] < 5
    assert numbers["together"] < numbers["cost at start"]
    assert user_code("31_codesign_gripper") <= 60

    chain, x = names["chain"], jnp.full(9, 0.45)
    near = chain(x)[1]
    with pytest.raises(RuntimeError, match="drawing_to_loop: rod: In balance, but not stable"):
        chain(x.at[5].set(7.0), near)  # 290 kPa

    def total(x):
        return chain(x, near)[0] @ jnp.array([1.0, 2.0, 3.0])

    slope = jax.grad(total)(x)
    for k, way in enumerate(1e-4 * jnp.eye(9)[:8]):
        seen = (total(x + way) - total(x - way)) / 2e-4
        assert float(slope[k]) == pytest.approx(float(seen), rel=1e-3, abs=1e-4)


def test_a_rod_in_free_flight_keeps_its_momentum():
    numbers = main_of("43_flying_spaghetti")(quick=True)
    assert numbers["ended well"] == 1
    assert numbers["momentum lost in free flight"] < 1e-7
    assert numbers["impulse over momentum"] == pytest.approx(1, rel=1e-6)
    assert user_code("43_flying_spaghetti") <= 60


@pytest.mark.slow
def test_a_finger_learns_to_reach():
    with jax.numpy_dtype_promotion("standard"):  # optax mixes integers and floats
        numbers = main_of("44_reach")(quick=True)
    assert (
        numbers["reward of the last episodes"] > numbers["reward of the first episodes"] + 0.1
    )
    assert numbers["median distance at the end [mm]"] < 15  # 30 mm where nothing is learnt
    assert numbers["diverged"] == 0
    assert user_code("44_reach") <= 60


@pytest.mark.slow
def test_a_finger_learns_from_samples():
    with jax.numpy_dtype_promotion("standard"):
        numbers = main_of("45_ppo")(quick=True)
    assert numbers["reward of the last update"] > numbers["reward of the first update"] + 0.05
    assert user_code("45_ppo") <= 60


@pytest.mark.slow
def test_gradients_and_a_tuned_controller_beside_ppo():
    with jax.numpy_dtype_promotion("standard"):
        numbers = main_of("46_two_ways_to_learn")(quick=True)
    assert numbers["PI: reached [%]"] > numbers["random: reached [%]"] + 30
    assert numbers["gradients: reached, mean [%]"] > numbers["random: reached [%]"] + 15
    assert user_code("46_two_ways_to_learn") <= 60


@pytest.mark.slow
def test_a_policy_behind_the_board_keeps_most_of_its_return():
    with jax.numpy_dtype_promotion("standard"):
        numbers = main_of("47_policy_on_a_bench")(quick=True)
    assert 80 < numbers["kept of the return [%]"] < 101
    assert user_code("47_policy_on_a_bench") <= 60


@pytest.mark.slow
def test_an_arm_with_a_pneumatic_finger_picks_a_ball():
    """In the air nothing but the finger holds the ball, and every joint is in balance."""
    pytest.importorskip("mujoco", reason="the extra `robots` is not installed")
    main = main_of("40_arm_picks_ball")
    numbers = main(quick=True)
    assert numbers["lift [mm]"] > 100
    assert numbers["finger on ball over weight"] == pytest.approx(1, abs=0.1)
    assert numbers["moved in the grip [mm]"] < 4
    script = main.__globals__
    setup, ticks = script["scene"](), jnp.array(script["PERIOD"] * np.arange(650))
    q, v = script["run"](setup, ticks)
    assert robots_arm.unbalanced(script["forces"], setup, ticks, q, v) < 1e-8
    assert user_code("40_arm_picks_ball") <= 60


@pytest.mark.slow
def test_three_rods_carry_a_platform():
    numbers = main_of("42_three_rods")(quick=True)
    assert numbers["ended well"] == 1
    assert numbers["clamp open by [m]"] < 1e-10
    # platform and rods, by the density of the rubber
    assert 0.1 < numbers["push of the sliders at the start [N]"] < 1
    assert user_code("42_three_rods") <= 60
