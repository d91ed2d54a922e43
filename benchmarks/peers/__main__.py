"""`python -m benchmarks.peers install [NAME...]`: one environment per peer."""

import argparse
import json
import subprocess
import sys
import venv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.peers.call import PeerMissing, call, home, interpreter, status


@dataclass(frozen=True)
class Peer:
    """What to install, which module must import afterwards, and a task whose first run
    compiles what later ones load."""

    requirements: tuple[str, ...]
    module: str
    licence: str
    first: dict[str, Any] | None = None


PEERS = {
    "soromox": Peer(("soromox>=0.5,<0.6",), "soromox", "MIT"),
    "felupe": Peer(
        (
            "felupe>=11,<12",
            "pypardiso>=0.4; platform_machine == 'x86_64' and sys_platform != 'darwin'",
        ),
        "felupe",
        "GPL-3.0: only in its own process",
    ),
    "pyelastica": Peer(
        ("pyelastica>=1.0,<2",),
        "elastica",
        "MIT",
        {
            "task": "simulation",
            "elements": 10,
            "share": 0.3,
            "duration": 1e-3,
            "save_dt": 1e-3,
            "repeats": 1,
        },
    ),
    # From version 4 on it does not read the cable element any more.
    "mujoco": Peer(("mujoco>=3.3,<4",), "mujoco", "Apache-2.0"),
    "scikit_fem": Peer(("scikit-fem>=12,<13",), "skfem", "BSD-3-Clause"),
    "sdf_fork": Peer(("sdf-fork>=0.1.1,<0.2", "scikit-image"), "sdf", "MIT"),
    "gmsh": Peer(("gmsh>=4.13,<5", "numpy"), "gmsh", "GPL-2.0+: only in its own process"),
    "jax_fem": Peer(
        # the wheel does not name what it imports
        (
            "jax-fem>=0.0.11",
            "jax",
            "scipy",
            "pyfiglet",
            "meshio",
            "matplotlib",
            "gmsh",
            "fenics-basix",
        ),
        "jax_fem.problem",
        "GPL-3.0: only in its own process",
    ),
    "diffrax": Peer(("diffrax>=0.7,<0.8",), "diffrax", "Apache-2.0"),
    "torch_fem": Peer(("torch-fem>=0.14,<0.15",), "torchfem", "MIT"),
}


def install(name: str) -> dict:
    """Make the environment of one peer; the outcome is kept in its `status.json`."""
    peer, folder = PEERS[name], home() / name
    outcome = {"ok": False, "licence": peer.licence}
    try:
        venv.create(folder, clear=True, with_pip=True)
        _run(interpreter(name), "-m", "pip", "install", "-q", *peer.requirements)
        found = f"from importlib.metadata import version as v; print(v({name!r}))"
        _run(interpreter(name), "-I", "-c", f"import {peer.module}")
        outcome |= {"ok": True, "version": _run(interpreter(name), "-I", "-c", found).strip()}
    except (OSError, subprocess.CalledProcessError) as error:
        outcome["reason"] = _reason(error)
    _keep(folder, outcome)
    if outcome["ok"] and peer.first:
        try:
            call(name, arrays={}, **peer.first)
        except PeerMissing as reason:
            outcome |= {"ok": False, "reason": str(reason)}
            _keep(folder, outcome)
    return outcome


def _keep(folder: Path, outcome: dict[str, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "status.json").write_text(json.dumps(outcome, indent=1) + "\n")


def _run(*command: str | Path) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return done.stdout


def _reason(error: Exception) -> str:
    lines = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
    errors = [text for text in lines if "error" in text.lower()]
    return (errors or lines)[-1][:300]


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", description=__doc__)
    parser.add_argument("command", choices=["install", "status"])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PEERS)}")
    arguments = parser.parse_args(argv)
    if unknown := [name for name in arguments.names if name not in PEERS]:
        parser.error(f"no peer {', '.join(unknown)}, need some of {', '.join(PEERS)}")
    for name in arguments.names or PEERS:
        outcome = install(name) if arguments.command == "install" else status(name)
        tail = outcome["version"] if outcome["ok"] else f"not available: {outcome['reason']}"
        print(f"{name:<10} {tail}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
