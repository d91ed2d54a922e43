"""A JAX that is too old is refused in one line, a newer one than any tested is only told."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sorojax._jax import versions

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize(
    ("jax", "jaxlib"),
    [
        ("0.10.2", "0.10.2"),
        ("0.10.3", "0.10.3"),
        ("0.12.0.1", "0.12.0.1"),
        ("0.12.0.dev20261101", "0.12.0.dev20261028"),
        ("0.12.0.1+local.2", "0.11.2"),
        ("0.100.0", "0.100.0"),
        ("1.0.0rc1", "1.0"),
        ("", ""),
        ("unknown", "unknown"),
    ],
)
def test_jax_from_the_oldest_on_is_taken(jax, jaxlib):
    assert versions._wrong(jax, jaxlib) is None


@pytest.mark.parametrize(
    ("jax", "jaxlib", "told"),
    [
        ("0.9.2", "0.9.2", "found jax 0.9.2, need jax 0.10.2 or newer"),
        ("0.4.38", "0.4.38", "found jax 0.4.38, need jax 0.10.2 or newer"),
        ("0.9.0.1", "", "found jax 0.9.0.1, need jax 0.10.2 or newer"),
        (None, None, "found no jax, need jax 0.10.2 or newer with its jaxlib"),
        ("0.10.2", None, "found no jaxlib, need jax 0.10.2 or newer with its jaxlib"),
        ("0.10.2", "0.12.0.1", "found jaxlib 0.12.0.1 beside jax 0.10.2, need a jax as new"),
    ],
)
def test_jax_that_does_not_fit_is_refused(jax, jaxlib, told, monkeypatch):
    monkeypatch.setattr(versions, "installed", {"jax": jax, "jaxlib": jaxlib}.get)
    with pytest.raises(ImportError) as refused:
        versions.check()
    command = "pip install --upgrade 'jax>=0.10.2'"
    assert str(refused.value) == f"sorojax: {told}. Install it: {command}"


def test_tested_versions():
    assert all(map(versions.is_tested, versions.TESTED)) and versions.is_tested("0.12.0.1")
    assert not any(map(versions.is_tested, ("0.10.1", "0.12", "0.13.0", "")))
    assert versions.TESTED[0] == versions.OLDEST
    assert f"jax>={versions.OLDEST}" in (ROOT / "pyproject.toml").read_text()


def test_a_package_without_metadata_has_no_version(tmp_path, monkeypatch):
    (tmp_path / "checkout_of_something.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    assert versions.installed("checkout_of_something") == ""
    assert versions.installed("nothing_of_this_name") is None
    assert versions.installed("pytest") == pytest.__version__


@pytest.mark.versions
def test_an_old_jax_ends_the_import_with_one_error(tmp_path):
    for name in ("jax", "jaxlib"):
        about = tmp_path / f"{name}-0.6.2.dist-info"
        about.mkdir()
        text = f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.6.2\n"
        (about / "METADATA").write_text(text)
        (tmp_path / f"{name}.py").write_text("raise AttributeError('imported')\n")
    done = subprocess.run(
        [sys.executable, "-c", "import sorojax"],
        env={"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        "ImportError: sorojax: found jax 0.6.2, need jax 0.10.2 or newer. "
        "Install it: pip install --upgrade 'jax>=0.10.2'"
    )
    assert done.stderr.count("Traceback") == 1
