"""What `make test-versions` makes of files, bounds and reports."""

import sys
import tomllib
from pathlib import Path

import pytest

from tests import versions as V
from tests.test_architecture import FLOOR

PROJECT = tomllib.loads((V.ROOT / "pyproject.toml").read_text())["project"]
REPORT = """<testsuites><testsuite><testcase classname="tests.test_a" name="good"/>
<testcase classname="tests.test_a" name="bad"><failure message="no"/></testcase>
<testcase classname="tests.test_a" name="gone"><skipped/></testcase>
<testcase classname="tests.test_a" name="late"><error/></testcase></testsuite></testsuites>"""
GOOD = '<testsuite><testcase classname="tests.test_a" name="good"/></testsuite>'


def program(path: Path, text: str) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def test_interpreters_are_those_that_run(tmp_path):
    files = [
        program(tmp_path / "shims" / "python3.12", "echo 'command not found' >&2; exit 127"),
        program(tmp_path / "shims" / "python3.12-config", "echo cpython 3 12"),
        program(tmp_path / "other" / "python3.14", "echo cpython 3 13"),
        program(tmp_path / "other" / "python3.13", "echo pypy 3 13"),
        program(tmp_path / "right" / "python3.12", "echo cpython 3 12"),
        program(tmp_path / "later" / "python3.12", "echo cpython 3 12"),
        program(tmp_path / "right" / "python3.9", "echo cpython 3 9"),
        program(tmp_path / "right" / "python3.11", "echo cpython 3 11"),
        tmp_path / "absent" / "python3.15",
    ]
    found = V.interpreters(files, "3.11")
    assert found == {"3.11": files[7], "3.12": files[4]} and list(found) == ["3.11", "3.12"]


def test_this_interpreter_is_found(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("PYENV_ROOT", str(tmp_path))
    here = [file for file in V.candidates() if file.name == f"python{V.THIS}"]
    assert here == [Path(sys.base_prefix) / "bin" / f"python{V.THIS}"]


def test_later_releases_of_pyenv_come_first(monkeypatch, tmp_path):
    monkeypatch.setenv("PYENV_ROOT", str(tmp_path))
    for release in ("3.13.9", "3.13.10"):
        (tmp_path / "versions" / release / "bin").mkdir(parents=True)
        (tmp_path / "versions" / release / "bin" / "python3.13").touch()
    mine = [f.parts[-3] for f in V.candidates() if f.is_relative_to(tmp_path)]
    assert mine == ["3.13.10", "3.13.9"]


def test_bounds_become_pins():
    project = {
        "name": "this",
        "dependencies": ["jax>=0.10.0", "numpy >= 1.26, <3", "pillow>=10"],
        "optional-dependencies": {
            "pardiso": ["mkl>=2024; platform_machine == 'x86_64'"],
            "test": ["pytest[all]>=8", "this[sweep,vision]"],
            "sweep": ["distributed>=2024.8"],
            "vision": ["pillow>=10"],
            "view": ["pyvista>=0.43"],
        },
    }
    assert V.pins(project) == [
        "jax==0.10.0", "jaxlib==0.10.0", "numpy==1.26", "pillow==10",
        "mkl==2024 ; platform_machine == 'x86_64'", "pytest==8", "distributed==2024.8",
    ]  # fmt: skip
    project["dependencies"].append("scipy<2")
    with pytest.raises(ValueError, match="scipy<2.*lowest version"):
        V.pins(project)


def test_every_dependency_has_a_lowest_version():
    names = [line.split("==")[0] for line in V.pins(PROJECT)]
    assert {"jax", "jaxlib", "numpy", "mkl", "pytest"} <= set(names)
    assert len(names) == len(set(names))


def test_rows_by_their_names():
    found = {v: Path(f"python{v}") for v in ("3.11", "3.12", "3.13")}
    every = V.rows(found, "3.11", this="3.12")
    assert [row.name for row in V.chosen(every, "3.13,oldest")] == ["3.13", "oldest"]
    assert V.chosen(every, "") == list(every.values())
    assert every["oldest"].python == found["3.11"]
    assert [row.name for row in V.chosen(every, "newest", this="3.11")] == ["3.13", "3.12"]
    assert V.chosen(every, "newest", this="3.13") == []
    with pytest.raises(SystemExit, match="no row 3.15 on this machine, has 3.11"):
        V.chosen(every, "3.15")


def test_without_avx512_with_a_cache_of_its_own(monkeypatch):
    monkeypatch.setattr(V.platform, "machine", lambda: "x86_64")
    monkeypatch.setenv("XLA_FLAGS", "--xla_other=1")
    row = V.rows({"3.12": Path("python3.12")}, "3.11", this="3.12")["avx2"]
    assert row.environment == "3.12" and "avx2" in row.flags["SOROJAX_CACHE"]
    assert row.flags["XLA_FLAGS"] == "--xla_other=1 --xla_cpu_max_isa=AVX2"
    monkeypatch.setattr(V.platform, "machine", lambda: "arm64")
    assert "avx2" not in V.rows({"3.12": Path("python3.12")}, "3.11", this="3.12")


@pytest.mark.parametrize(
    ("report", "status", "bad"),
    [(GOOD, 0, False), (REPORT, 1, True), (REPORT, 0, True), (GOOD, 3, True), (None, 2, True)],
)
def test_a_failure_is_counted_and_ends_with_one(
    report, status, bad, tmp_path, monkeypatch, capsys
):
    file = tmp_path / "report.xml"
    if report:
        file.write_text(report)
    row = V.Row("3.12", Path("python3.12"), "3.12")
    result = V.judged(row, ["3.12.1", "0.11"], file, status, 61.4)
    assert result.bad == bad == bool(result.note)
    if report == REPORT:
        assert result.counts == {"passed": 1, "failed": 1, "errors": 1, "skipped": 1}
        assert "not passed: tests.test_a::bad" in capsys.readouterr().out
    monkeypatch.setattr(V, "chosen", lambda *_: [row])
    monkeypatch.setattr(V, "run", lambda *_: result)
    assert V.main([]) == int(bad)


def test_an_environment_is_made_again_where_the_project_needs_something_else(
    monkeypatch, tmp_path
):
    calls, status = [], 0
    monkeypatch.setattr(V, "MADE", tmp_path)
    monkeypatch.setattr(V, "OUT", tmp_path)
    monkeypatch.setattr(V.subprocess, "call", lambda c, **_: calls.append(c) or status)
    row = V.Row("oldest", Path("python3.12"), "oldest")
    row.own_python.parent.mkdir(parents=True)
    for project, expected in [(PROJECT, 2), (PROJECT, 2), (PROJECT | {"version": "9"}, 4)]:
        assert V.install(row, project) and len(calls) == expected
    assert (
        "jaxlib==" in (tmp_path / "oldest.txt").read_text()
        and tmp_path / "oldest.txt" in calls[1]
    )
    status = 1
    assert not V.install(row, PROJECT) and not V.install(row, PROJECT)


@pytest.mark.parametrize(
    ("name", "environment", "bad"),
    [("3.99", "3.99", False), ("3.13", "3.13", True), ("oldest", "oldest", True)],
)
def test_what_cannot_be_installed_fails_where_it_is_supported(
    name, environment, bad, monkeypatch, tmp_path
):
    monkeypatch.setattr(V, "install", lambda *_: False)
    result = V.run(V.Row(name, tmp_path, environment), PROJECT, "2", [])
    assert result.bad == bad and result.note.startswith("not installed")


def test_the_newest_that_can_be_installed_is_run_and_no_other(monkeypatch, capsys):
    asked = [V.Row(v, Path(f"python{v}"), v) for v in ("3.99", "3.13", "3.12")]
    monkeypatch.setattr(V, "chosen", lambda *_: asked)
    results = {"3.99": V.Result("3.99"), "3.13": V.Result("3.13", "3.13.0", "0.12")}
    monkeypatch.setattr(V, "run", lambda row, *_: results[row.name])
    assert V.main(["--only", "newest"]) == 0
    asked.clear()
    assert V.main(["--only", "newest"]) == 0
    assert "found no Python above" in capsys.readouterr().out


def test_the_table_has_a_line_for_every_row():
    counts = dict(zip(("passed", "failed", "errors", "skipped"), (812, 1, 0, 5), strict=True))
    text = V.table(
        [
            V.Result("oldest", "3.11.7", "0.10.0", counts, "1020", "see x.log", True),
            V.Result("3.14", note="not installed, see y.log"),
        ]
    )
    assert [line.split() for line in text.splitlines()] == [
        ["row", "python", "jax", "passed", "failed", "errors", "skipped", "seconds"],
        ["oldest", "3.11.7", "0.10.0", "812", "1", "0", "5", "1020", "see", "x.log"],
        ["3.14", *"-------", "not", "installed,", "see", "y.log"],
    ]


def test_the_newest_python_sees_every_floor():
    """`.ci/run` runs there what is marked `versions`."""
    marked = [
        f.name for f in V.ROOT.glob("tests/test_*.py") if "mark.versions" in f.read_text()
    ]
    rooms = {*FLOOR, "hardware"} - {"__main__"}
    missing = [
        r for r in rooms if not any(f.startswith(f"test_{r.lstrip('_')}") for f in marked)
    ]
    assert missing == []
