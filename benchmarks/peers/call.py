"""Asking a peer: a JSON request and arrays in, a JSON answer and arrays out."""

import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.rows import Row, missing

HERE = Path(__file__).parent


class PeerMissing(Exception):
    """A peer that is not installed, or that failed; the message says why."""


def home() -> Path:
    """Where the environments of the peers are: `.peers` beside the packages."""
    return Path(os.environ.get("SOROJAX_PEERS", HERE.parent.parent / ".peers"))


def interpreter(peer: str) -> Path:
    folder = home() / peer
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def status(peer: str) -> dict[str, Any]:
    """What the installation recorded: `ok`, and `version` or `reason`."""
    file = home() / peer / "status.json"
    if not file.exists():
        return {"ok": False, "reason": f"not installed: make peers PEERS={peer}"}
    return json.loads(file.read_text())


def call(
    peer: str,
    task: str,
    arrays: dict[str, np.ndarray],
    limit: float = 900.0,
    environment: dict[str, str] | None = None,
    **options: Any,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Run `task` of `peers/<peer>.py` in a process of its own.

    The script finds `request.json` and `request.npz` in the folder that is its only
    argument and leaves `answer.json` and `answer.npz` there. It inherits the pinned
    core of the case, and its environment unless another is given.

    Raises:
        PeerMissing: With the reason.
    """
    state = status(peer)
    if not state["ok"]:
        raise PeerMissing(state["reason"])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "request.json").write_text(json.dumps({"task": task} | options))
        np.savez(folder / "request.npz", **arrays)
        _run(peer, folder, limit, environment)
        answer = json.loads((folder / "answer.json").read_text())
        with np.load(folder / "answer.npz") as file:
            return answer | {"version": state["version"]}, dict(file)


def _run(peer: str, folder: Path, limit: float, environment: dict[str, str] | None) -> None:
    # Isolated, so that `soromox.py` here does not shadow the package that it imports.
    command = [interpreter(peer), "-I", HERE / f"{peer}.py", folder]
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=limit,
            env=(os.environ if environment is None else environment)
            | {"JAX_TRACEBACK_FILTERING": "off"},  # the last line is then the reason
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise PeerMissing(str(error)) from error
    if done.returncode or not (folder / "answer.npz").exists():
        lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
        raise PeerMissing(lines[-1])


def row(
    peer: str,
    task: str,
    arrays: dict[str, np.ndarray],
    error: Any,
    reference: Any,
    **options: Any,
) -> Row:
    """The row of a peer; `error` is a function of the arrays that it answers.

    The script answers `compile_s` and `runs`, seconds per call.
    """
    try:
        answer, result = call(peer, task, arrays, **options)
    except PeerMissing as reason:
        return missing(peer, str(reason), **options)
    runs = sorted(answer["runs"])
    told = {
        key: answer[key] for key in ("version", "solver", "iterations", "step") if key in answer
    }
    return Row(
        peer,
        options | told,
        answer["compile_s"],
        runs[len(runs) // 2],
        runs[0],
        runs[-1],
        error(result),
        reference,
    )
