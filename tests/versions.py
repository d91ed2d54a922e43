"""The tests on every interpreter of this machine and on the oldest dependencies, one row
after another, with one table at the end:

    python -m tests.versions --only 3.13,oldest -- tests/test_units.py

Rows are `3.11` and so on with the newest dependencies that pip finds, `oldest` with every
`>=` of pyproject.toml read as `==` on the lowest Python, `avx2` on this Python without
AVX-512 and with the compiler flags that users have, and `newest`, the newest above this one.
"""

import argparse
import dataclasses
import hashlib
import json
import os
import platform
import re
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

ROOT = Path(__file__).parent.parent
MADE, OUT = ROOT / ".venvs", ROOT / "out" / "versions"
THIS = f"3.{sys.version_info.minor}"
# `ensurepip` is a package of its own on some systems, without which there is no environment.
_ASK = "import ensurepip, sys, venv; print(sys.implementation.name, *sys.version_info[:2])"
_SAY = "import importlib.metadata as m, sys; print(sys.version.split()[0], m.version('jax'))"


@dataclasses.dataclass(frozen=True)
class Row:
    """What a row of the table needs: an interpreter and an environment in `.venvs`."""

    name: str
    python: Path
    environment: str
    flags: dict[str, str] = dataclasses.field(default_factory=dict)

    @property
    def own_python(self) -> Path:
        return MADE / self.environment / "bin" / "python"

    def log(self, kind: str) -> Path:
        return OUT / f"{self.name}.{kind}"


@dataclasses.dataclass(frozen=True)
class Result:
    """What a row found. Without `counts` no test ran, for the reason in `note`."""

    name: str
    python: str = "-"
    jax: str = "-"
    counts: dict[str, int] | None = None
    seconds: str = "-"
    note: str = ""
    bad: bool = False


def order(version: str) -> tuple[int, ...]:
    """`3.9` before `3.11`."""
    return tuple(map(int, re.findall(r"\d+", version)))


def candidates() -> Iterator[Path]:
    """Files `python3.N`: of this interpreter, on the PATH, of pyenv."""
    folders = [Path(sys.base_prefix) / "bin", *map(Path, os.get_exec_path())]
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv")
    kept = sorted(pyenv.glob("versions/*/bin"), key=lambda f: order(f.parent.name))
    for folder in folders + kept[::-1]:
        yield from sorted(folder.glob("python3.*"))


def interpreters(files: Iterable[Path], lowest: str) -> dict[str, Path]:
    """By version the first interpreter that runs and can make an environment. A file is no
    proof: those of pyenv on the PATH may stand for a version that is switched off."""
    found: dict[str, Path] = {}
    for file in files:
        version = file.name.removeprefix("python")
        known = not re.fullmatch(r"3\.\d+", version) or version in found
        if not known and order(version) >= order(lowest) and _runs(file, version):
            found[version] = file
    return dict(sorted(found.items(), key=lambda item: order(item[0])))


def _runs(file: Path, version: str) -> bool:
    try:
        done = subprocess.run([file, "-c", _ASK], capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0 and done.stdout.split() == ["cpython", *version.split(".")]


def pins(project: dict[str, Any]) -> list[str]:
    """The lowest versions that a project allows of what its tests need."""
    needed, pinned = list(project["dependencies"]), []
    for extra in ("pardiso", "test", "envs", "sweep", "vision"):
        needed += project["optional-dependencies"].get(extra, ())
    for line in needed:
        requirement, _, where = line.partition(";")
        name = re.split(r"[^\w.-]", requirement.strip())[0]
        if name == project["name"]:  # extras of its own, which are listed
            continue
        lowest = re.search(r">=\s*([\w.]+)", requirement)
        if lowest is None:
            raise ValueError(f"pyproject.toml: `{line}` has no `>=`, need the lowest version.")
        pinned.append(f"{name}=={lowest[1]}" + (f" ; {where.strip()}" if where else ""))
        if name == "jax":
            pinned.append(f"jaxlib=={lowest[1]}")
    return list(dict.fromkeys(pinned))


def newest_supported(project: dict[str, Any]) -> str:
    text = "\n".join(project["classifiers"])
    return max(re.findall(r"Python :: (3\.\d+)$", text, re.M), key=order)


def rows(found: dict[str, Path], lowest: str, this: str = THIS) -> dict[str, Row]:
    """Every row that this machine has, by name."""
    every = {version: Row(version, python, version) for version, python in found.items()}
    if lowest in found:
        every["oldest"] = Row("oldest", found[lowest], "oldest")
    if this in found and platform.machine().lower() in ("x86_64", "amd64"):
        flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_max_isa=AVX2".strip()
        own = {"XLA_FLAGS": flags, "SOROJAX_CACHE": str(MADE / "avx2-cache")}
        every["avx2"] = Row("avx2", found[this], this, own)
    return every


def chosen(every: dict[str, Row], only: str, this: str = THIS) -> list[Row]:
    """Rows by their names, all without names. `newest` is every version above this one, the
    highest first: `main` stops at the first that can be installed."""
    if not only:
        return list(every.values())
    if only == "newest":
        above = [v for v in every if v[0].isdigit() and order(v) > order(this)]
        return [every[v] for v in reversed(above)]
    if unknown := set(only.split(",")) - every.keys():
        has = f"has {', '.join(every)} and, alone, newest"
        raise SystemExit(f"versions: no row {', '.join(unknown)} on this machine, {has}.")
    return [every[name] for name in only.split(",")]


def install(row: Row, project: dict[str, Any]) -> bool:
    """Make the environment of a row, unless what the project needs is as it was then."""
    folder = MADE / row.environment
    needs = json.dumps([str(row.python), project]).encode()
    made, digest = folder / "made", hashlib.sha256(needs).hexdigest()
    if made.exists() and made.read_text() == digest:
        return True
    print(f"{row.name}: making .venvs/{row.environment}", flush=True)
    pip = [row.own_python, "-m", "pip", "install", "--disable-pip-version-check"]
    if row.environment == "oldest":
        MADE.mkdir(exist_ok=True)
        (MADE / "oldest.txt").write_text("\n".join(pins(project)) + "\n")
        pip += ["-c", MADE / "oldest.txt"]
    with row.log("install.log").open("w") as log:

        def call(*command: str | Path) -> bool:
            return not subprocess.call(command, cwd=ROOT, stdout=log, stderr=log)

        done = call(row.python, "-m", "venv", "--clear", folder) and (
            call(*pip, "-e", ".[pardiso,test]")
            or call(*pip, "-e", ".[test]")  # `mkl` exists for some platforms only
        )
    if done:
        made.write_text(digest)
    return done


def tally(report: Path) -> tuple[dict[str, int], list[str]]:
    """How many tests of a JUnit report passed, failed and so on, and which did not pass."""
    counts, bad = dict.fromkeys(("passed", "failed", "errors", "skipped"), 0), []
    words = {"failure": "failed", "error": "errors", "skipped": "skipped"}
    for case in ElementTree.parse(report).iter("testcase"):
        inside = [words[part.tag] for part in case if part.tag in words]
        word = next((w for w in words.values() if w in inside), "passed")
        counts[word] += 1
        if word in ("failed", "errors"):
            bad.append(f"{case.get('classname')}::{case.get('name')}".strip(":"))
    return counts, bad


def run(row: Row, project: dict[str, Any], workers: str, arguments: list[str]) -> Result:
    """Install and test one row."""
    OUT.mkdir(parents=True, exist_ok=True)
    if not install(row, project):
        where = row.log("install.log").relative_to(ROOT)
        needed = order(row.environment) <= order(newest_supported(project))
        return Result(row.name, note=f"not installed, see {where}", bad=needed)
    said = subprocess.check_output([row.own_python, "-c", _SAY], text=True).split()
    print(f"{row.name}: jax {said[1]}, output in {row.log('log')}", flush=True)
    report, start = row.log("xml"), time.monotonic()
    report.unlink(missing_ok=True)
    command = [row.own_python, "-m", "pytest", "-n", workers, "--dist", "loadfile"]
    command += ["--max-worker-restart", "0", f"--junitxml={report}", *arguments]
    with row.log("log").open("w") as log:
        own = os.environ | row.flags
        status = subprocess.call(command, cwd=ROOT, env=own, stdout=log, stderr=log)
    return judged(row, said, report, status, time.monotonic() - start)


def judged(row: Row, said: list[str], report: Path, status: int, seconds: float) -> Result:
    """A row is bad if pytest says so or if its report does."""
    counts, bad = tally(report) if report.exists() else (None, [])
    print("".join(f"{row.name}: not passed: {name}\n" for name in bad[:20]), end="")
    wrong = status != 0 or bool(bad)
    note = f"pytest ended with {status}, see {row.log('log').relative_to(ROOT)}"
    return Result(row.name, *said, counts, f"{seconds:.0f}", note * wrong, wrong)


def table(results: list[Result]) -> str:
    """One line a row."""
    form = "{:8} {:8} {:10} {:>7} {:>7} {:>7} {:>7} {:>8}  {}".format
    heads = ("row", "python", "jax", "passed", "failed", "errors", "skipped", "seconds", "")
    lines = [form(*heads)]
    for r in results:
        counts = r.counts.values() if r.counts else ["-"] * 4
        lines.append(form(r.name, r.python, r.jax, *counts, r.seconds, r.note))
    return "\n".join(line.rstrip() for line in lines)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.versions")
    parser.add_argument("--only", default="", help="rows, with commas between them")
    parser.add_argument("--workers", default="2", help="processes of a row")
    parser.add_argument("pytest", nargs="*", help="arguments of pytest, after --")
    asked = parser.parse_args(arguments)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lowest = project["requires-python"].removeprefix(">=")
    results: list[Result] = []
    for row in chosen(rows(interpreters(candidates(), lowest), lowest), asked.only):
        results.append(run(row, project, asked.workers, asked.pytest))
        if asked.only == "newest" and results[-1].jax != "-":
            break
    if not results:
        print(f"versions: found no Python above {THIS}, so only {THIS} is tested.")
        return 0
    print(table(results))
    return int(any(result.bad for result in results))


if __name__ == "__main__":
    sys.exit(main())
