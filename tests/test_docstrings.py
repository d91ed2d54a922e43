"""Docstrings of the verbs that a user starts with: every argument is described, what comes
back is said, and the example runs."""

import doctest
import importlib
import inspect
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sorojax
from sorojax import SE2, SE3, material, silent
from sorojax.units import kPa, mm

pytestmark = pytest.mark.quick

VERBS = {
    "": "compiled jit replace",
    "sdf": "SmoothUnion area contour extrude gradient isosurface offset revolve rotate "
    "translate union volume",
    "mesh": "box enrich extrude facets_on move nodes_where polymesher rectangle "
    "tetrahedralise triangulate",
    "material": "by_region fit_cyclic fit_spectrum fit_tensile neo_hookean preconditioned "
    "predicted_readings stress_history uniaxial_spectrum",
    "material.presets": "rubber",
    "fem": "bonded_rod cauchy_stress continuation critical_loads eigenmodes embedded_rod glue "
    "problem reaction_history reactions rod_forces simulate solve solve_path solve_volume "
    "von_mises_stress",
    "rod": "assembly branch_states bspline chebyshev circle close_loops equilibrium "
    "equilibrium_path forward_dynamics forward_kinematics inverse_kinematics "
    "joint_wrenches mobility motion_from_velocity operators piecewise_constant rod "
    "rollout tip_pose with_closures",
    "coupling": "mounted_rod",
    "reduction": "identify pod_basis strain_along",
    "systems": "Network sampled_body simulate simulate_batch simulate_sampled",
    "design": "calibrate drawing_to_loop layout minimise minimise_shape propagate_covariance",
    "robots": "actuator_forces arm_mjcf bellows_problem computed_torque mount stepper",
    "envs": "randomised register reset solid_finger step step_with_reset to_brax "
    "to_gymnasium to_gymnasium_vector",
    "io": "export_mesh export_mjcf import_robot import_surface load save",
    "view": "png show",
    "vision": "calibrate",
    "sweep": "sweep",
}
PATHS = [
    f"{package}.{name}".lstrip(".") for package in VERBS for name in VERBS[package].split()
]
NAMES = {
    "sj": sorojax, "jax": jax, "jnp": jnp, "np": np, "SE2": SE2, "SE3": SE3, "mm": mm,
    "kPa": kPa, "material": material, "presets": material.presets,
}  # fmt: skip
PACKAGES = (
    "coupling", "design", "envs", "fem", "io", "mesh", "reduction", "robots", "rod", "sdf",
    "sweep", "systems", "view", "vision",
)  # fmt: skip
SECTIONS = ("Args", "Attributes", "Returns", "Raises", "Example", "Reference", "References")


def verb(path: str):
    """The documented object: checks of arguments wrap it."""
    package, _, name = path.rpartition(".")
    module = importlib.import_module(f"sorojax.{package}".rstrip("."))
    return inspect.unwrap(getattr(module, name))


def sections(text: str) -> dict[str, str]:
    """The parts of a docstring by their headings."""
    found = re.split(rf"^({'|'.join(SECTIONS)}):", inspect.cleandoc(text), flags=re.MULTILINE)
    return dict(zip(found[1::2], found[2::2], strict=True))


def described(part: str) -> list[str]:
    """Names at the beginning of the entries of `Args:`; "lower, upper: ..." are two."""
    heads = re.findall(r"^    ([\w*]+(?:, [\w*]+)*):", part, flags=re.MULTILINE)
    return [name.strip(" *") for head in heads for name in head.split(",")]


@pytest.mark.parametrize("path", PATHS)
def test_every_argument_is_described(path):
    thing = verb(path)
    parts = sections(thing.__doc__)
    is_class = inspect.isclass(thing)
    listed = described(parts.get("Attributes" if is_class else "Args", ""))
    assert listed == list(inspect.signature(thing).parameters)
    assert is_class or parts.get("Returns", "").strip()


@pytest.mark.parametrize("path", PATHS)
def test_the_example_runs(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # examples of `io` write files
    names = NAMES | {name: importlib.import_module(f"sorojax.{name}") for name in PACKAGES}
    text = sections(verb(path).__doc__).get("Example", "")
    example = doctest.DocTestParser().get_doctest(text, names, path, None, None)
    assert example.examples and any(one.want for one in example.examples)
    said: list[str] = []
    runner = doctest.DocTestRunner(verbose=False)
    with silent():
        runner.run(example, out=said.append)
    assert runner.failures == 0, "".join(said)
