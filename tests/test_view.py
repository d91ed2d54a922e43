"""Pictures are looked at by their pixels, the report by what it must keep."""

import base64
import functools
import io
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import _progress, fem, material, mesh as M, rod as R, sdf, view
from sorojax.fem.equilibrium.solve import Path
from sorojax.math.lie import SE2
from sorojax.math.status import Status
from sorojax.reduction.backbone import Backbone

LENGTH = 0.06
ORANGE, INK = (213, 94, 0), (31, 36, 48)


@pytest.fixture(scope="module")
def beam():
    return M.rectangle([0.0, -0.005], [LENGTH, 0.005], divisions=(12, 2), order=2)


@pytest.fixture(scope="module")
def rod():
    basis = R.chebyshev(kappa_z=2)
    return R.rod(
        SE2(),
        basis,
        R.rectangle(0.01, 0.02),
        length=LENGTH,
        young_modulus=1e5,
        poisson_ratio=0.49,
        density=1e3,
        nodes=24,
    )


@functools.cache
def pixels(picture):
    from PIL import Image

    data = picture if isinstance(picture, bytes) else view.png(picture)
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)


def ink(picture):
    """Fraction of the picture that is not white."""
    return float(np.mean(np.any(pixels(picture) < 250, axis=2)))


def has(picture, colour, least=30, tol=12):
    close = np.all(np.abs(pixels(picture) - np.array(colour)) <= tol, axis=2)
    return int(close.sum()) >= least


def has_margin(picture):
    """Nothing touches the border, so no label is cut off."""
    image = pixels(picture)
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    return bool(np.all(border > 250))


def bend(mesh, kappa):
    """Displacement of a straight body along x bent to a constant curvature."""
    x, y = np.asarray(mesh.points).T
    angle = kappa * x
    moved = np.stack(
        [(1 / kappa - y) * np.sin(angle), 1 / kappa - (1 / kappa - y) * np.cos(angle)], axis=1
    )
    return moved - np.asarray(mesh.points)


@pytest.fixture(scope="module")
def path(beam):
    facets = M.facets_where(beam, lambda p: jnp.abs(p[0] - LENGTH) < 1e-9)
    problem = fem.problem(
        beam,
        material.neo_hookean(young_modulus=1e5, poisson_ratio=0.4),
        kinematics=fem.PlaneStrain(0.02),
        supports=(fem.Fixed(M.nodes_where(beam, lambda p: p[0] < 1e-9)),),
        loads=(fem.Traction(facets, [0.0, 0.0], name="pull"),),
    )
    states = jnp.asarray(np.stack([0 * bend(beam, 1.0)] + [bend(beam, k) for k in (5.0, 15.0)]))
    values = jnp.array([0.0, 1.0, 2.0])
    return Path(problem, states, values, "pull", Status.successful, ())


@pytest.mark.versions
def test_deformed_shapes_show_the_stress(path):
    figure = view.show(path, title="beam").figure
    assert 0.08 < ink(figure) < 0.7 and has_margin(figure)
    assert has(figure, (68, 1, 84)) and has(figure, (253, 231, 37))  # both ends of the map
    titles = [axes.get_title() for axes in figure.axes[:3]]
    assert titles == ["pull = 0 kPa", "pull = 1 Pa", "pull = 2 Pa"]
    assert "kPa" in figure.axes[-1].get_ylabel()


def test_deformed_shapes_take_another_field_and_reject_a_missing_state(path):
    figure = view.show(
        path, states=[-1], field=lambda problem, u: 1e3 * u[:, 1], label="deflection [mm]"
    ).figure
    assert len(figure.axes) == 2 and "deflection [mm]" in figure.axes[-1].get_ylabel()
    with pytest.raises(ValueError, match="there are states 0 to 2"):
        view.show(path, states=[3])


@pytest.mark.parametrize("per", ["node", "cell", None])
def test_a_mesh_is_drawn_with_its_cells(beam, per):
    count = {"node": beam.num_nodes, "cell": beam.num_cells, None: 0}[per]
    field = np.arange(count) if per else None
    figure = view.show(beam, field=field, label="number [-]").figure
    assert ink(figure) > 0.1 and has_margin(figure)
    assert has(figure, (68, 1, 84)) == bool(per)


def test_a_field_of_the_wrong_length_is_named(beam):
    with pytest.raises(ValueError, match="one value per node"):
        view.show(beam, field=np.zeros(3))


def test_a_shape_shows_both_sides_and_its_zero_set():
    ring = sdf.Circle([0.0, 0.0], 0.02) - sdf.Circle([0.0, 0.0], 0.008)
    figure = view.show(ring).figure
    image = pixels(figure)
    assert has_margin(figure) and has(figure, INK, least=300)
    blue, red = image[..., 2] - image[..., 0] > 60, image[..., 0] - image[..., 2] > 60
    assert blue.sum() > 2000 and red.sum() > 2000


def test_modes_have_a_panel_per_strain():
    basis = R.chebyshev(kappa_z=3, sigma_x=1)
    energy = {"kappa_z": 0.9999999, "sigma_x": 0.5}
    figure = view.show(basis, length=LENGTH, energy=energy).figure
    assert len(figure.axes) == 2 and has_margin(figure)
    assert "99.9999 %" in figure.axes[0].get_title(loc="left")
    assert "1/m" in figure.axes[0].get_ylabel() and "mm" in figure.axes[1].get_xlabel()


def test_backbone_errors_are_those_of_the_picture(rod):
    s = jnp.linspace(0.0, 1.0, 21)
    qs = jnp.array([[0.0, 0.0], [10.0, 1.0], [20.0, 2.0]])
    lines = jax.vmap(lambda q: R.forward_kinematics(rod, q, s)[:, :2, 2])(qs)
    shifted = lines + jnp.array([0.0, 5e-4])[None, None]
    backbone = Backbone(s, jnp.asarray(LENGTH), shifted, jnp.zeros((3, 21, 3)))
    errors = view.backbone_errors(backbone, rod, qs)
    assert np.allclose(errors, 5e-4, rtol=1e-12)
    figure = view.show_backbones(backbone, rod, qs, pressures=np.array([0.0, 1e4, 2e4])).figure
    drawn = figure.axes[1].lines[0].get_ydata()
    assert np.allclose(drawn, 0.5) and has_margin(figure)
    assert has(figure, ORANGE) and has(figure, INK)


def test_signals_keep_references_apart():
    time = np.linspace(0, 1, 50)
    panels = {
        "tip angle [deg]": {"reference": time, "rod": time**2},
        "pressure [kPa]": {"chamber": 20 * time},
    }
    figure = view.show_signals(time, panels).figure
    assert [axes.get_ylabel() for axes in figure.axes] == list(panels)
    assert figure.axes[0].lines[0].get_linestyle() != figure.axes[0].lines[1].get_linestyle()
    assert has_margin(figure) and has(figure, (0, 114, 178))
    with pytest.raises(ValueError, match="one number per instant"):
        view.show_signals(time, {"x [-]": {"y": time[:3]}})


def test_a_material_fit_passes_its_points():
    strain, stress = material.presets.DRAGON_SKIN_30_POINTS
    fit = material.fit_tensile(strain, stress, density=1080.0)
    figure = view.show(fit, points=(strain, stress)).figure
    stretch, curve = figure.axes[0].lines[1].get_data()
    c = fit.material
    x = stretch**2 + 2 / stretch - 3
    exact = 2 * (stretch - stretch**-2) * (c.c1 + 2 * c.c2 * x + 3 * c.c3 * x**2)
    assert np.allclose(1e3 * curve, exact, rtol=1e-10, atol=1e-6)  # Pa
    assert has(figure, ORANGE) and has_margin(figure)


@pytest.fixture(scope="module")
def film(beam):
    time = np.linspace(0.0, 0.4, 41)
    states = np.stack([np.asarray(beam.points) + bend(beam, 1e-6 + 40 * t) for t in time])
    body = view.scene_of(beam).parts[0]
    scale = view.Scale("pressure [kPa]", 0.0, 20.0, colours="OrRd")

    def scene(k):
        colour = np.full(beam.num_nodes, 50 * time[k])
        return view.Scene((view.Surface(states[k], body.triangles, values=colour),))

    made = view.animate(view.Track(time, scene, scale), size=(640, 400), title="bending")
    seen = []
    with _progress.listen(seen.append):
        assert made.gif
    return made, seen


def test_a_film_moves_in_real_time(film):
    from PIL import Image

    made, seen = film
    assert (seen[-1].label, seen[-1].done, seen[-1].total) == ("film", 9, 9)
    gif = Image.open(io.BytesIO(made.gif))
    assert (gif.n_frames, gif.size, gif.info["duration"]) == (9, (640, 400), 50)
    frames = []
    for k in range(gif.n_frames):
        gif.seek(k)
        frames.append(np.asarray(gif.convert("RGB")).astype(int))
    changed = [
        np.mean(np.any(a != b, axis=2)) for a, b in zip(frames, frames[1:], strict=False)
    ]
    assert all(0.002 < share < 0.3 for share in changed)
    red, green, _ = np.moveaxis(frames[-1], 2, 0)
    assert np.sum(red - green > 60) > 1000  # the chamber is under pressure
    assert np.sum(np.any(frames[0] < 200, axis=2)) > 1000
    assert len(made.gif) < 3e5


def test_a_film_names_times_that_do_not_rise(beam):
    scene = view.scene_of(beam)
    with pytest.raises(ValueError, match="rise strictly"):
        view.animate(view.Track(np.zeros(3), lambda k: scene))


def test_the_report_is_one_file(film):
    time = np.linspace(0, 1, 5)
    figure = view.show_signals(time, {"x [m]": {"x": time}})
    html = view.html_report(
        "A <robot>",
        [
            view.Section("Motion", "One & two.\n\nThree.", [("film", film[0]), ("x", figure)]),
            view.Section(
                "Numbers",
                numbers=[
                    view.Number("error", 1.23456e-7, "m", "< 1 mm", True),
                    view.Number("gradient", 0.5, "-", "< 0.1", False),
                    view.Number("cells", 2545),
                ],
            ),
        ],
        lead="By <one> command.",
    )
    assert "A &lt;robot&gt;" in html and "By &lt;one&gt;" in html and "<robot>" not in html
    assert not re.search(r"(src|href)\s*=\s*[\"'](?!data:|#)", html)
    assert "http" not in html and "url(" not in html and "<script" not in html
    sources = re.findall(r'src="data:image/(\w+);base64,([^"]+)"', html)
    assert [kind for kind, _ in sources] == ["gif", "png"]
    assert base64.b64decode(sources[0][1]) == film[0].gif
    assert ink(base64.b64decode(sources[1][1])) > 0.01
    assert "1.235e-7" in html and "2545" in html
    assert html.count(">\u2713 holds<") == 1 and html.count(">\u2717 missed<") == 1


LOADED = """
import sys, sorojax.view
first = sorted({"matplotlib", "PIL"} & sys.modules.keys())
import sorojax.view.draw.shapes, sorojax.view.raster.solid  # what a solid shape is drawn with
solvers = {"matplotlib", "diffrax", "sorojax.fem", "sorojax.rod"}
print(first, sorted(solvers & sys.modules.keys()))
"""


@pytest.mark.versions
def test_the_floor_loads_no_drawing_library_and_shapes_no_solver():
    done = subprocess.run(
        [sys.executable, "-c", LOADED], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[] []"


def test_every_name_of_the_floor_is_there():
    names = [name for name in dir(view) if not name.startswith("_")]
    assert {"animate", "live", "rig", "show", "to_html"} <= set(names)
    for name in names:
        assert getattr(view, name) is not None
    assert all(callable(getattr(view, name)) for name in ("animate", "live", "rig", "show"))
