"""`sorojax robots`: a printable body as a file, with the checks that a print needs."""

import argparse
import dataclasses
import sys
from pathlib import Path

KINDS = {
    "bending": "BendingActuator",
    "planar": "PlanarActuator",
    "hand": "Hand",
    "manipulator": "Manipulator",
}


def add(commands) -> None:
    """The parser of the command."""
    parser = commands.add_parser("robots", help="a printable robot as STL, 3MF, PLY or OBJ")
    parser.add_argument("name", choices=KINDS)
    parser.add_argument("--out", type=Path, help="the file (default: NAME.stl)")
    parser.add_argument("--size", type=float, default=0.5, help="of a cell [mm]")
    parser.add_argument("--wall", type=float, help="least wall to accept [mm]")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="DIMENSION=VALUE",
        dest="dimensions",
        help="another dimension [mm, degrees for angles]; `--list` names them",
    )
    parser.add_argument("--list", action="store_true", help="print the dimensions and stop")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the body and print what was checked on the file as read back.

    Raises:
        ValueError: If a dimension is unknown, or the body fails a check.
    """
    from sorojax import io, robots, sdf

    robot = _changed(getattr(robots, KINDS[arguments.name])(), arguments.dimensions)
    if arguments.list:
        for name, value in _dimensions(robot).items():
            print(f"{name:<30} {value:g}")
        return 0
    out = arguments.out or Path(f"{arguments.name}.stl")
    io.export_surface(out, sdf.isosurface(robot.body(), arguments.size * 1e-3))
    report = sdf.surface_report(io.import_surface(out))
    print(_described(report))
    if not report.watertight:
        raise ValueError(f"{out} is not watertight. Use a smaller --size.")
    wall = report.wall_thickness * 1e3
    if arguments.wall is not None and wall < arguments.wall:
        raise ValueError(
            f"{out}: the thinnest wall is {wall:.2f} mm, asked for {arguments.wall:g} mm. Make "
            "the walls thicker with --set."
        )
    print(f"wrote {out}", file=sys.stderr)
    return 0


def _dimensions(robot, prefix: str = "") -> dict[str, float]:
    """Numbers of the robot and its parts in mm and degrees, counts as integers."""
    found = {}
    for field in dataclasses.fields(robot):
        name, value = prefix + field.name, getattr(robot, field.name)
        if dataclasses.is_dataclass(value):
            found |= _dimensions(value, f"{name}.")
        elif isinstance(value, int):
            found[name] = value
        elif getattr(value, "ndim", None) == 0:
            found[name] = float(value) / _unit(field.name)
    return found


def _unit(name: str) -> float:
    from sorojax.units import deg, mm

    return deg if "angle" in name or name == "splay" else mm


def _changed(robot, changes: list[str]):
    known = _dimensions(robot)
    for text in changes:
        name, _, value = text.partition("=")
        if name not in known:
            raise ValueError(f"no dimension {name!r}, need one of {', '.join(known)}")
        try:
            number = float(value)
        except ValueError:
            raise ValueError(f"--set {text}: {value!r} is no number") from None
        is_count, path = isinstance(known[name], int), name.split(".")
        robot = _replaced(robot, path, round(number) if is_count else number * _unit(path[-1]))
    return robot


def _replaced(robot, names: list[str], value):
    if len(names) > 1:
        value = _replaced(getattr(robot, names[0]), names[1:], value)
    return dataclasses.replace(robot, **{names[0]: value})


def _described(report) -> str:
    shells = "one shell" if report.num_shells == 1 else f"{report.num_shells} shells"
    state = "watertight" if report.watertight else "NOT watertight"
    wall = f"{report.wall_thickness * 1e3:.2f} mm"
    return (
        f"{state}, {shells}, genus {report.genus}, {len(report.crossings)} crossing triangles, "
        f"volume {report.volume * 1e6:.2f} cm3, thinnest wall {wall}"
    )
