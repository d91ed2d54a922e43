"""An accelerator that is asked for or installed and does not work: the CPU, one warning."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sorojax._jax import devices

pytestmark = pytest.mark.skipif(
    devices._any_plug_in(), reason="an accelerator is installed, whose absence is tested"
)
ROOT = Path(__file__).parent.parent
REGISTERS = """
def initialize():
    from jax._src import xla_bridge
    xla_bridge.register_backend_factory("fake", client, priority=400, fail_quietly=False)
def client():
    """
PLUG_INS = {
    "not loaded": "raise ImportError('libfake.so: cannot open')",
    "not loaded at all": "raise OSError('libfake.so: cannot open')",
    "without its library": "import a_library_that_is_not_there",
    "not initialised": "def initialize():\n    raise RuntimeError('the driver is too old')",
    "without a device": REGISTERS + "raise RuntimeError('no supported devices')",
    "without a client": REGISTERS + "return None",
}
COMMAND = """
import sys
from sorojax.cli.main import main
status = main(["info"])
"""
LIBRARY = """
import jax
import sorojax as sj
sj.rod, sj.fem
from jax._src import xla_bridge
assert not xla_bridge.backends_are_initialized()
made = sj.SE3(), sj.sdf.Circle([0, 0], 1.0).radius
print("devices ", jax.devices()[0].platform)
"""

ROD = """
import jax
import sorojax as sj
jax.config.update("jax_enable_x64", True)
thin = sj.rod.taper(sj.rod.circle, 5e-3, 2e-3)
rubber = sj.rod.elastic(sj.material.presets.dragon_skin_30())
sj.rod.rod(sj.SE2(), sj.rod.chebyshev(kappa_z=2), thin, rubber, length=0.1)
print("devices ", jax.devices()[0].platform)
"""


def run(program: str, tmp_path: Path, plug_in: str = "", **environment: str):
    """Run a program beside a plug-in of JAX, and give what it prints and its warnings."""
    if plug_in:
        about = tmp_path / "fake_plug_in-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text("Metadata-Version: 2.1\nName: fake\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text("[jax_plugins]\nfake = fake_plug_in\n")
        (tmp_path / "fake_plug_in.py").write_text(plug_in + "\n")
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    own = {"PYTHONPATH": path, "SOROJAX_CACHE": str(tmp_path / "cache"), "JAX_PLATFORMS": ""}
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | own | environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def is_on_the_cpu(told: str) -> bool:
    return any("cpu" in line.lower() for line in told.splitlines() if "devices " in line)


def warning(stderr: str) -> str:
    """The only warning; nothing else is told but the line of code that it shows."""
    lines = [line for line in stderr.splitlines() if not line.startswith("  ")]
    assert len(lines) == 1 and "UserWarning: sorojax: " in lines[0], stderr
    assert "set JAX_PLATFORMS=cpu" in lines[0] and "jax[cuda13]" in lines[0]
    return lines[0]


@pytest.mark.versions
@pytest.mark.parametrize("plug_in", PLUG_INS.values(), ids=PLUG_INS)
def test_a_command_runs_on_the_cpu_beside_a_broken_plug_in(plug_in, tmp_path):
    told, errors = run(COMMAND, tmp_path, plug_in)
    assert is_on_the_cpu(told)
    assert "a plug-in of JAX failed (" in warning(errors)
    assert "using the CPU" in errors


@pytest.mark.parametrize("platforms", ["fake", "cuda", "gpu,cpu", "tpu"])
def test_a_command_runs_on_the_cpu_where_what_is_asked_for_fails(platforms, tmp_path):
    plug_in = PLUG_INS["not initialised"]
    told, errors = run(COMMAND, tmp_path, plug_in, JAX_PLATFORMS=platforms)
    assert is_on_the_cpu(told)
    assert f"JAX_PLATFORMS={platforms} failed (the driver is too old)" in warning(errors)


def test_who_asks_for_the_cpu_hears_nothing_of_a_broken_plug_in(tmp_path):
    plug_in = PLUG_INS["not loaded at all"]
    told, errors = run(COMMAND, tmp_path, plug_in, JAX_PLATFORMS="cpu")
    assert is_on_the_cpu(told) and errors == ""


@pytest.mark.versions
@pytest.mark.parametrize("platforms", ["cuda", "gpu", "rocm,cuda", "cuda,cpu"])
@pytest.mark.parametrize("program", [COMMAND, LIBRARY], ids=["command", "library"])
def test_without_any_plug_in_the_cpu_is_used(program, platforms, tmp_path):
    told, errors = run(program, tmp_path, JAX_PLATFORMS=platforms)
    assert is_on_the_cpu(told)
    wrong = f"JAX_PLATFORMS={platforms} failed (no plug-in of JAX is installed), using the CPU."
    assert wrong in warning(errors)


@pytest.mark.parametrize("name", ["not loaded at all", "without a device", "without a client"])
@pytest.mark.parametrize("platforms", ["", "fake"])
def test_a_rod_is_made_on_the_cpu_where_jax_does_not_start(name, platforms, tmp_path):
    told, errors = run(ROD, tmp_path, PLUG_INS[name], JAX_PLATFORMS=platforms)
    assert is_on_the_cpu(told) and "using the CPU" in warning(errors)


@pytest.mark.parametrize("platforms", ["", "cpu", "cpu,proxy"])
def test_an_import_changes_and_says_nothing_where_no_accelerator_is_named(platforms, tmp_path):
    program = "import sorojax, jax; print(repr(jax.config.jax_platforms or ''))"
    assert run(program, tmp_path, JAX_PLATFORMS=platforms) == (f"{platforms!r}\n", "")
