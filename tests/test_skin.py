"""Skins at rest, at known shapes and near branches; modifiers against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import rod as R, sdf, view
from sorojax.math.lie import SE2, SE3, homogeneous, rotation_columns
from sorojax.view.rigging import modifiers
from sorojax.view.rigging.rig import placed

pytestmark = pytest.mark.quick

LENGTH = 0.06
RUBBER = {"young_modulus": 1e5, "poisson_ratio": 0.49, "density": 1e3}


@pytest.fixture(scope="module")
def planar():
    return R.rod(SE2(), R.chebyshev(kappa_z=2), R.circle(0.005), length=LENGTH, **RUBBER)


@pytest.fixture(scope="module")
def spatial():
    basis = R.chebyshev(kappa_x=1, kappa_y=2, kappa_z=2, sigma_x=1)
    return R.rod(SE3(), basis, R.circle(0.005), length=LENGTH, nodes=16, **RUBBER)


@pytest.fixture(scope="module")
def gripper(spatial):
    """Two fingers on a link that slides; they start 30 mm apart and point along x."""
    at = [homogeneous(jnp.eye(3), jnp.array([0.0, y, 0.0])) for y in (-0.015, 0.015)]
    palm = R.Part(R.Link(0.1, [1e-4, 1e-4, 2e-4]), R.Prismatic([1.0, 0.0, 0.0]))
    fingers = {f"finger_{k}": R.Part(spatial, on="palm", offset=at[k]) for k in (0, 1)}
    return R.assembly(SE3(), palm=palm, **fingers)


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(0)
    return rng.uniform([-0.01, -0.004, -0.004], [LENGTH + 0.01, 0.004, 0.004], (300, 3))


Q = jnp.array([3.0, 8.0, -4.0, 12.0, 5.0, 0.1])


def test_a_skin_at_rest_is_the_surface(planar, spatial, gripper, cloud):
    for model, points in ((planar, cloud[:, :2]), (spatial, cloud), (gripper, 2 * cloud)):
        skin = view.bind(points, model)
        still = view.deform(skin, model, R.rest(model))
        assert jnp.allclose(still, points, rtol=0, atol=1e-15)


def test_a_skin_may_be_bound_to_a_bent_rod_at_its_base(spatial, cloud):
    base = homogeneous(jnp.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), jnp.array([0.1, 0, 0]))
    skin = view.bind(cloud, spatial, Q, base=base)
    assert jnp.allclose(view.deform(skin, spatial, Q), cloud, rtol=0, atol=1e-15)
    straight = view.deform(view.bind(cloud, spatial), spatial, Q)
    turned = view.bind(cloud @ base[:3, :3].T + base[None, :3, 3], spatial, base=base)
    expect = straight @ base[:3, :3].T + base[None, :3, 3]
    assert jnp.allclose(view.deform(turned, spatial, Q), expect, rtol=0, atol=1e-12)


def test_points_follow_the_sections_of_the_rod(spatial):
    rng = np.random.default_rng(1)
    s = jnp.asarray(rng.uniform(size=200))
    local = jnp.asarray(np.pad(rng.uniform(-0.004, 0.004, (200, 2)), ((0, 0), (1, 0))))
    points = local.at[:, 0].set(LENGTH * s)
    moved = view.deform(view.bind(points, spatial), spatial, Q)
    poses = R.forward_kinematics(spatial, Q, s)
    exact = jnp.einsum("pij,pj->pi", poses[:, :3, :3], local) + poses[:, :3, 3]
    # Rotations are linear between 65 stations: second order in their distance.
    assert float(jnp.max(jnp.abs(moved - exact))) < 2e-5 * LENGTH


def test_sections_stay_flat_and_ends_move_rigidly(planar):
    kappa = 60.0  # more than half a turn
    points = jnp.array([[LENGTH, 0.004], [LENGTH + 0.01, 0.004], [-0.01, 0.003]])
    skin = view.bind(points, planar)
    tip, beyond, behind = view.deform(skin, planar, jnp.array([kappa, 0.0]))
    angle = kappa * LENGTH
    forward = jnp.array([jnp.cos(angle), jnp.sin(angle)])
    normal = jnp.array([-forward[1], forward[0]])
    centre = jnp.array([jnp.sin(angle), 1 - jnp.cos(angle)]) / kappa
    assert jnp.allclose(tip, centre + 0.004 * normal, rtol=0, atol=1e-12)
    assert jnp.allclose(beyond, tip + 0.01 * forward, rtol=0, atol=1e-12)
    assert jnp.allclose(behind, points[2], rtol=0, atol=1e-12)


def test_a_planar_rod_carries_a_solid(planar, cloud):
    q = jnp.array([20.0, 4.0])
    moved = view.deform(view.bind(cloud, planar), planar, q)
    flat = view.deform(view.bind(cloud[:, :2], planar), planar, q)
    assert jnp.allclose(moved[:, :2], flat, rtol=0, atol=1e-12)
    assert jnp.allclose(moved[:, 2], cloud[:, 2], rtol=0, atol=1e-15)


def test_parts_share_points_smoothly(gripper):
    q = R.rest(gripper).at[0].set(0.01).at[1:7].set(Q)  # the palm slides, one finger bends
    line = np.linspace([0.02, -0.02, 0.0], [0.02, 0.02, 0.0], 2001)
    skin = view.bind(line, gripper, blend=0.01)
    assert len(skin.more) > 0
    moved = np.asarray(view.deform(skin, gripper, q))
    steps = np.linalg.norm(np.diff(moved, axis=0), axis=1)
    straight = line[-100:] + np.array([0.01, 0.0, 0.0])
    assert np.allclose(moved[-100:], straight, rtol=0, atol=1e-12)  # the other finger's own
    sharp = view.deform(view.bind(line, gripper, blend=0.0), gripper, q)
    assert np.linalg.norm(np.diff(sharp, axis=0), axis=1).max() > 20 * steps.max()


def test_only_the_named_parts_carry(gripper, cloud):
    q = R.rest(gripper).at[0].set(0.01).at[1:7].set(Q)
    moved = view.deform(view.bind(cloud, gripper, parts=("palm",)), gripper, q)
    shift = jnp.array([[0.01, 0.0, 0.0]])
    assert jnp.allclose(moved, cloud + shift, rtol=0, atol=1e-15)


def test_skins_are_differentiable(spatial, cloud):
    skin = view.bind(cloud, spatial)

    def height(q):
        return jnp.sum(view.deform(skin, spatial, q)[:, 1] ** 2)

    gradient = jax.grad(height)(Q)
    step = 1e-5 * jnp.eye(len(Q))
    central = jnp.array([(height(Q + e) - height(Q - e)) / 2e-5 for e in step])
    assert jnp.allclose(gradient, central, rtol=1e-6, atol=1e-12)
    assert jnp.all(jnp.isfinite(jax.grad(height)(jnp.zeros_like(Q))))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda rod: view.bind(np.zeros((2, 4)), rod), "need \\(points, 2\\)"),
        (lambda rod: view.bind(np.zeros((2, 2)), rod), "three coordinates"),
        (lambda rod: view.bind(np.full((2, 3), np.nan), rod), "finite"),
        (lambda rod: view.bind(np.zeros((2, 3)), rod, parts=("palm",)), "some of \\['rod'\\]"),
        (lambda rod: view.bind(np.zeros((2, 3)), rod, stations=2), "3 or more"),
        (lambda rod: view.rig(rod, (np.zeros((2, 3)), [[0, 1, 2]])), "some of 2"),
        (lambda rod: view.rig(rod, blend=0.01), "without a `surface`"),
        (lambda rod: view.pose(view.rig(rod), np.zeros(2)), "6 coordinates"),
    ],
)
def test_errors_say_what_to_do(spatial, call, words):
    with pytest.raises(ValueError, match=words):
        call(spatial)


def test_a_rod_without_a_surface_is_a_tube_of_its_section(spatial, planar):
    for rod, section in ((spatial, R.circle(0.005)), (planar, R.ring(0.006, 0.004))):
        rod = R.rod(rod.group, rod.basis, section, length=LENGTH, nodes=rod.nodes, **RUBBER)
        rig = view.rig(rod, around=96)
        points = np.asarray(view.pose(rig))
        report = sdf.surface_report(sdf.Surface(points, np.asarray(rig.triangles)))
        assert report.watertight and report.num_shells == 1 and report.genus == 0
        radius = np.hypot(points[:-2, 1], points[:-2, 2])
        assert np.allclose(radius, radius[0], rtol=1e-12)
        outer = float(np.sqrt(rod.section.area / np.pi)) if rod is spatial else radius[0]
        assert report.volume == pytest.approx(np.pi * outer**2 * LENGTH, rel=2e-3)
    assert radius[0] == pytest.approx(0.006, rel=1e-12)  # the outside of the ring


def test_rigs_of_assemblies_move_with_every_part(gripper):
    rig = view.rig(gripper, around=8, stations=17)
    qs = jnp.stack([R.rest(gripper), R.rest(gripper).at[0].set(0.02)])
    first, second = view.pose(rig, qs)
    assert jnp.allclose(second - first, jnp.array([[0.02, 0.0, 0.0]]), rtol=0, atol=1e-12)
    outline = np.array([[0.0, 0.0], [0.004, 0.0], [0.0, 0.004]])
    rig = view.rig(gripper, outline={"finger_1": outline}, around=8, stations=17)
    tubes = sdf.surface_report(
        sdf.Surface(np.asarray(view.pose(rig)), np.asarray(rig.triangles))
    )
    assert tubes.watertight and tubes.num_shells == 3
    ball = (
        4 / 3 * np.pi * np.prod([0.0707, 0.0707, 0.0])
    )  # a flat link has no volume of its own
    assert tubes.volume > ball + 0.004**2 / 2 * LENGTH


def test_bodies_are_placed_by_quaternions():
    rng = np.random.default_rng(2)
    points, where = rng.normal(size=(5, 3)), rng.normal(size=(4, 3))
    q = rng.normal(size=(4, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    moved = placed(points, where, q)
    for k in range(4):
        R_k = np.stack([np.array(c) for c in rotation_columns(tuple(q[k]))], axis=1)
        assert np.allclose(moved[k], points @ R_k.T + where[k], rtol=0, atol=1e-14)
    assert np.allclose(placed(points, where[0], q[0]), moved[0], rtol=0, atol=1e-15)
    assert np.allclose(placed(points, where), points + where[:, None], rtol=0, atol=1e-15)


BAR = np.stack(np.meshgrid(np.linspace(0, 1, 9), [-0.1, 0.1], [-0.1, 0.1]), -1).reshape(-1, 3)


def test_bending_makes_an_arc():
    kappa = np.pi / 2
    bent = modifiers.bend(BAR, kappa)
    angle, r = kappa * BAR[:, 0], 1 / kappa - BAR[:, 1]
    exact = np.stack([r * np.sin(angle), 1 / kappa - r * np.cos(angle), BAR[:, 2]], axis=1)
    assert np.allclose(bent, exact, rtol=0, atol=1e-14)
    half = modifiers.bend(BAR, kappa, towards="z", start=0.25, end=0.5)
    still, beyond = BAR[:, 0] <= 0.25, BAR[:, 0] >= 0.5
    assert np.allclose(half[still], BAR[still], rtol=0, atol=1e-15)
    gaps = [np.linalg.norm(np.diff(x, axis=0), axis=1) for x in (half[beyond], BAR[beyond])]
    assert np.allclose(*gaps, rtol=0, atol=1e-14)
    slope = jax.jacfwd(lambda k: modifiers.bend(BAR, k))(0.0)
    assert np.allclose(slope[:, 1], BAR[:, 0] ** 2 / 2, rtol=0, atol=1e-12)


def test_twisting_and_tapering():
    turned = modifiers.twist(BAR, np.pi / 2)
    end = BAR[:, 0] == 1.0
    assert np.allclose(turned[end], np.stack([BAR[end, 0], -BAR[end, 2], BAR[end, 1]], 1))
    thin = modifiers.taper(BAR, 0.5, start=0.0, end=1.0)
    scale = 1 - 0.5 * BAR[:, :1]
    assert np.allclose(thin, BAR * np.concatenate([np.ones_like(scale), scale, scale], 1))


def test_sweeping_along_a_circle_is_bending():
    kappa = 2.0
    t = np.linspace(0, 0.8, 81)
    circle = np.stack([np.sin(kappa * t), 1 - np.cos(kappa * t), 0 * t], axis=1) / kappa
    swept = modifiers.sweep(BAR, circle, up=[0.0, 1.0, 0.0])
    bent = modifiers.bend(BAR, kappa, end=0.8)
    assert np.allclose(swept, bent, rtol=0, atol=3e-5)
    # frames do not turn about a helix: what was across stays across
    helix = np.stack([np.cos(5 * t), np.sin(5 * t), t], axis=1)
    swept = np.asarray(modifiers.sweep(BAR, helix))
    widths = np.linalg.norm(swept[BAR[:, 2] > 0] - swept[BAR[:, 2] < 0], axis=1)
    assert np.allclose(widths, 0.2, rtol=0, atol=1e-12)


def test_copies_and_mirror_images_face_outwards():
    box = sdf.isosurface(sdf.Box([0.1, 0.1, 0.1], [0.3, 0.4, 0.3]), 0.05)
    one = sdf.surface_report(box)
    for points, triangles, count in (
        (*modifiers.array(*box, [0.5, 0.0, 0.0], 3), 3),
        (*modifiers.mirror(*box, [1.0, 1.0, 0.0]), 2),
    ):
        report = sdf.surface_report(sdf.Surface(np.asarray(points), triangles))
        assert report.watertight and report.num_shells == count
        assert report.volume == pytest.approx(count * one.volume, rel=1e-12)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: modifiers.bend(BAR, 1.0, along="y"), "two axes"),
        (lambda: modifiers.bend(BAR[:, :2], 1.0, towards="z"), "one of x, y"),
        (lambda: modifiers.twist(BAR[:, :2], 1.0), "\\(points, 3\\)"),
        (lambda: modifiers.taper(BAR, 1.0, start=1.0, end=0.0), "lower place first"),
        (lambda: modifiers.sweep(BAR, np.zeros((2, 3))), "3 or more"),
        (lambda: modifiers.array(BAR, [[0, 1, 2]], [1.0, 0.0, 0.0], 0), "1 or more"),
    ],
)
def test_modifiers_say_what_they_need(call, words):
    with pytest.raises(ValueError, match=words):
        call()
