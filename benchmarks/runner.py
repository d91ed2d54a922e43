"""Runs each case in a process of its own, so that cases share no cache and no state."""

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.child import environment
from benchmarks.discover import HERE, workers
from benchmarks.rows import line, missing

TIME_LIMIT = 1800.0  # s per case


def run_case(name: str, file: Path, limit: float = TIME_LIMIT) -> Iterator[dict[str, Any]]:
    """The lines of one case. A case that fails adds a row with the reason."""
    with tempfile.TemporaryDirectory() as folder:
        lines, log = Path(folder) / "lines", Path(folder) / "log"
        lines.touch()
        reason = _run(name, file, lines, log, limit)
        for text in lines.read_text().splitlines():
            yield json.loads(text)
        if reason:
            print(f"{name}: {reason}\n{_tail(log, 15)}", file=sys.stderr)
            yield line(name, missing("sorojax", reason))


def _run(name: str, file: Path, lines: Path, log: Path, limit: float) -> str | None:
    """Why the case failed, `None` if it did not. A peer that it waits for ends with it."""
    command = [sys.executable, "-m", "benchmarks.child", name, str(file), str(lines)]
    with log.open("w") as out:
        child = subprocess.Popen(
            command,
            cwd=HERE.parent,
            env=os.environ | environment(workers(file)),
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            status = child.wait(limit)
        except subprocess.TimeoutExpired:
            return f"not finished after {limit:g} s"
        finally:
            if child.poll() is None:
                _kill(child)
    return None if status == 0 else _tail(log, 1) or f"exit status {status}"


def _kill(child: subprocess.Popen) -> None:
    if hasattr(os, "killpg"):
        os.killpg(child.pid, signal.SIGKILL)
    else:
        child.kill()
    child.wait()


def _tail(log: Path, count: int) -> str:
    return "\n".join(log.read_text(errors="replace").strip().splitlines()[-count:])
