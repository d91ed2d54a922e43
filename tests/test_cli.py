"""The command line: starts fast, says what is wrong in one line, keeps its cache private."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from hatchling.metadata.core import ProjectMetadata
from hatchling.plugin.manager import PluginManager

import sorojax
from sorojax._cache import cache_directory, enable_compilation_cache
from sorojax.cli.info import info
from sorojax.cli.main import main

ROOT = Path(__file__).parent.parent


def command(*words, **environment):
    return subprocess.run(
        [sys.executable, "-m", "sorojax", *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env=os.environ | environment,
    )


def test_version_is_that_of_the_package():
    assert ProjectMetadata(str(ROOT), PluginManager()).version == sorojax.__version__
    assert command("--version").stdout == f"sorojax {sorojax.__version__}\n"


@pytest.mark.versions
def test_info_names_versions_devices_precision_solvers_and_cache(tmp_path):
    done = command("info", SOROJAX_CACHE=str(tmp_path / "cache"))
    assert done.returncode == 0, done.stderr
    facts = dict(line.split(maxsplit=1) for line in done.stdout.splitlines())
    assert facts["float64"] == "on" and facts["jax"].startswith(f"{jax.__version__}, ")
    assert "superlu" in facts["solvers"] and facts["devices"]
    assert str(tmp_path) in facts["compilation"]


def test_info_tells_whether_jax_was_tested_and_which_fast_paths_are_off(monkeypatch):
    paths = {"small_kernels": "on", "host_call": "off: this jax has no such name"}
    monkeypatch.setattr("sorojax._jax.fast_paths", lambda: paths)
    installed = {"jax": "0.10.2", "jaxlib": "0.10.2"}
    monkeypatch.setattr("sorojax.cli.info._version", lambda name: installed.get(name, "1.0"))
    facts = info()
    assert facts["jax"] == f"0.10.2, tested with sorojax {sorojax.__version__}"
    assert facts["fast path small_kernels"] == "on"
    assert facts["fast path host_call"] == "off: this jax has no such name"
    for jax_and_lib in (("0.13.0", "0.13.0"), ("0.12.0.1", "0.10.2")):
        installed.update(zip(("jax", "jaxlib"), jax_and_lib, strict=True))
        assert f", not tested with sorojax {sorojax.__version__}" in info()["jax"]


def test_wrong_input_is_one_line_without_traceback(monkeypatch, capsys):
    def fails():
        raise ValueError("demo: `out` is wrong.\n  Name a folder.")

    monkeypatch.setattr("sorojax.cli.info.info", fails)
    monkeypatch.setattr("sorojax.cli.main._start_jax", lambda: None)
    monkeypatch.delenv("SOROJAX_DEBUG", raising=False)
    assert main(["info"]) == 2
    assert capsys.readouterr().err == "sorojax: demo: `out` is wrong. Name a folder.\n"
    monkeypatch.setenv("SOROJAX_DEBUG", "1")
    with pytest.raises(ValueError, match="wrong"):
        main(["info"])


def test_unknown_command_exits_with_2():
    with pytest.raises(SystemExit) as exit:
        main(["fly"])
    assert exit.value.code == 2


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache of its own; JAX gets its settings back."""
    names = (
        "jax_compilation_cache_dir",
        "jax_persistent_cache_min_compile_time_secs",
        "jax_persistent_cache_min_entry_size_bytes",
    )
    before = {name: getattr(jax.config, name) for name in names}
    monkeypatch.setenv("SOROJAX_CACHE", str(tmp_path / "cache"))
    yield cache_directory()
    for name, value in before.items():
        jax.config.update(name, value)


def test_cache_is_private(cache):
    old = os.umask(0)
    try:
        assert enable_compilation_cache() == cache
    finally:
        os.umask(old)
    folders = cache, cache.parent, cache.parent.parent
    assert [path.stat().st_mode & 0o777 for path in folders] == [0o700] * 3
    assert jax.config.jax_compilation_cache_dir == str(cache)


def test_cache_that_others_read_is_closed(cache):
    cache.mkdir(parents=True)
    cache.chmod(0o755)
    cache.parent.chmod(0o755)
    enable_compilation_cache()
    assert cache.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("mode", [0o770, 0o777, 0o702])
def test_cache_that_others_write_is_refused(cache, mode):
    cache.mkdir(parents=True)
    cache.parent.chmod(0o700)
    cache.chmod(mode)
    with pytest.raises(ValueError, match="need 0700"):
        enable_compilation_cache()


def test_cache_that_is_a_link_is_refused(cache, tmp_path):
    cache.parent.mkdir(mode=0o700, parents=True)
    cache.symlink_to(tmp_path)
    with pytest.raises(ValueError, match="link or belongs to someone else"):
        enable_compilation_cache()


def test_cache_that_cannot_be_made_warns(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("SOROJAX_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.warns(UserWarning, match="Set SOROJAX_CACHE"):
        assert enable_compilation_cache() is None


def test_cache_follows_the_user_directories(monkeypatch, tmp_path):
    monkeypatch.delenv("SOROJAX_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_directory().parent == tmp_path / "sorojax" / "jax"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_directory().parent == tmp_path / ".cache" / "sorojax" / "jax"


def test_programs_of_another_type_of_processor_stay_apart(cache, monkeypatch):
    monkeypatch.setattr("platform.processor", lambda: "of another make")
    assert cache_directory() != cache and cache_directory().parent == cache.parent


def test_cache_is_warmed_by_the_demo(cache, monkeypatch, capsys):
    def run(folder, quick):
        assert folder.is_dir() and not quick
        (cache / "jit_step-1-cache").touch()
        return 0

    monkeypatch.setattr("sorojax.cli.demo.run", run)
    assert main(["cache", "--warm"]) == 0
    assert "1 programs more" in capsys.readouterr().out


def test_cache_is_counted_and_cleared(cache, capsys):
    cache.mkdir(parents=True)
    (cache / "jit_step-1-cache").write_bytes(bytes(2_000_000))
    (cache / "jit_step-1-atime").write_bytes(bytes(8))
    (cache.parent / "notes").mkdir()
    (cache.parent / "notes" / "of-a-user").touch()
    assert main(["cache", "--info"]) == 0
    told = capsys.readouterr().out
    assert str(cache) in told and "1 programs, 2.0 MB" in told
    assert main(["cache", "--clear"]) == 0
    assert "1 programs deleted" in capsys.readouterr().out
    assert [path.name for path in cache.parent.iterdir()] == ["notes"]
    assert main(["cache", "--clear"]) == 0
    assert main(["cache"]) == 0
    assert "0 programs" in capsys.readouterr().out


def test_a_robot_is_written_with_its_checks(tmp_path, capsys):
    file = tmp_path / "planar.stl"
    wide = ["--set", "plate_thickness=5", "--set", "bellows.wall_thickness=1.6"]
    assert main(["robots", "planar", "--size", "1.5", "--out", str(file), *wide]) == 0
    told = capsys.readouterr().out
    assert "watertight, one shell, genus 1, 0 crossing" in told and file.stat().st_size > 10_000
    assert main(["robots", "planar", *wide, "--list"]) == 0
    listed = dict(line.split() for line in capsys.readouterr().out.splitlines())
    assert listed["plate_thickness"] == "5" and listed["bellows.wall_thickness"] == "1.6"
    assert main(["robots", "planar", "--set", "colour=3"]) == 2
    assert "no dimension 'colour', need one of bellows.outer_radius" in capsys.readouterr().err


def test_a_board_is_printed_and_too_few_pictures_are_refused(tmp_path, capsys):
    cv2 = pytest.importorskip("cv2")
    board = tmp_path / "board.png"
    assert main(["calibrate", "--print", str(board)]) == 0
    assert cv2.imread(str(board)).shape[:2] == (720, 960)
    assert main(["calibrate", str(board), "--out", str(tmp_path / "camera.json")]) == 2
    assert "1 pictures show 6 corners" in capsys.readouterr().err
    assert main(["calibrate", __file__]) == 2
