"""`sorojax show FILE`: a picture of a surface, a mesh, a result or a saved motion."""

import argparse
import os
import sys
import webbrowser
from pathlib import Path


def add(commands: argparse._SubParsersAction) -> None:
    """The command and its arguments."""
    parser = commands.add_parser("show", help="picture of a surface, mesh or result file")
    parser.add_argument("file", type=Path, help=".stl .obj .ply .vtu .pvd .msh .npz ...")
    parser.add_argument(
        "--out",
        type=Path,
        help="what to write: .png .pdf .svg, .webp, .gif or .mp4 of a .pvd "
        "(default: FILE.png in this folder)",
    )
    parser.add_argument("--field", help="values that colour it, e.g. von_mises")
    parser.add_argument(
        "--unit", type=float, metavar="M", help="1 in the file in metres (surfaces: 0.001)"
    )
    parser.add_argument("--view", default="iso", help="iso front back left right top bottom")
    parser.add_argument("--wire", action="store_true", help="draw cells")
    parser.add_argument("--open", action="store_true", help="open it where a display is")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the picture and say where."""
    from sorojax import view

    out = arguments.out or Path(f"{arguments.file.stem}.png")
    shared = {"field": arguments.field, "view": arguments.view, "renderer": _renderer()}
    if out.suffix.lower() in (".webp", ".gif", ".mp4", ".webm"):
        if arguments.file.suffix.lower() != ".pvd":
            raise ValueError(
                f"show: {out.suffix} is a film, need a .pvd of several results to draw one, "
                f"got {arguments.file.name}. Write a .png."
            )
        unit = {} if arguments.unit is None else {"unit": arguments.unit}
        view.animate_file(arguments.file, **unit, **shared).save(out)
    else:
        picture = view.show_file(
            arguments.file, unit=arguments.unit, wire=arguments.wire, **shared
        )
        picture.save(out)
    print(f"wrote {out}")
    if arguments.open:
        _open(out)
    return 0


def _renderer() -> str:
    import importlib.util

    return "auto" if importlib.util.find_spec("pyvista") else "own"


def _open(path: Path) -> None:
    """Hand the file to the viewer of the desktop, if there is one."""
    shown = "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    if sys.platform.startswith("linux") and not shown:  # not in a browser of the terminal
        print("there is no display to open it on", file=sys.stderr)
    else:
        webbrowser.open(path.resolve().as_uri())
