"""Small errors put into the kernels, one at a time: which of them no test sees.

    python -m tests.mutants --draw 60 --seed 1

Draws, from the syntax trees of the kernels of every floor, changes of a sign, a factor, an
index or a comparison, and omissions of a term or a check. Each is written into a copy of the
project, where the tests of its floor run until the first failure. `--room sorojax/rod` draws
there alone, `--list` shows what was drawn. Development only; an hour or two for sixty.

Survivors that change nothing are listed in `EQUIVALENT`, each with its reason.
"""

import argparse
import ast
import copy
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
LIMIT = 900  # s for the tests of one mutant

# Kernels and solvers of every floor, and the tests that shall see an error in them.
ROOMS = {
    "sorojax/math": [
        "test_math_*",
        "test_sparse",
        "test_refined",
        "test_rod_statics",
        "test_rod",
    ],
    "sorojax/sdf": ["test_sdf*", "test_surface"],
    "sorojax/material": ["test_material", "test_point_tangent"],
    "sorojax/mesh": ["test_mesh*", "test_shape_derivatives"],
    "sorojax/fem": ["test_fem*", "test_point_tangent", "test_partitioned"],
    "sorojax/contact": ["test_contact", "test_fem_contact*", "test_rod_contact"],
    "sorojax/rod": ["test_rod*", "test_math_rod", "test_link_contact", "test_self_contact"],
    "sorojax/systems": ["test_systems*", "test_shape_estimate", "test_waypoints"],
    "sorojax/reduction": ["test_reduction*", "test_waypoints"],
    "sorojax/design": ["test_design", "test_layout", "test_calibrate", "test_part"],
    "sorojax/io": ["test_io_*", "test_fem_loads", "test_web", "test_view*"],
    "hardware/pi/sorojax_board": ["test_board", "test_tcp_board", "test_hardware*"],
}

EQUIVALENT = {
    "sorojax/rod/model/section.py factor: r[:, None] / jnp.max(r) "
    "-> (r[:, None] * jnp.max(r))": (
        "the scale of functions that a least-squares fit combines"
    ),
    "sorojax/design/optimise/optimality.py omission: count + 1 -> (count)": (
        "the limit of a search that ends by rounding after some sixty halvings at most"
    ),
    "sorojax/mesh/plane/polymesh.py factor: 1.0 -> (2.0)": (
        "stands for the rise of level sides, which no ray crosses: the quotient is not used"
    ),
}


class Mutant(NamedTuple):
    """A change of one place.

    Attributes:
        file: Relative to the root.
        line: Where.
        kind: Sign, factor, index, comparison or omission.
        before: Source of the expression.
        after: Source that takes its place.
        text: The whole file with the change.
    """

    file: str
    line: int
    kind: str
    before: str
    after: str
    text: str

    @property
    def change(self) -> str:
        return f"{self.kind}: {self.before} -> {self.after}"

    @property
    def name(self) -> str:
        return f"{self.file}:{self.line} {self.change}"


_TURNED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
_SHIFTED = {ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt}


def changes(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """What may take the place of a node, with the kind of the error."""
    if isinstance(node, ast.BinOp):
        if (turned := _TURNED.get(type(node.op))) and not _is_text(node):
            yield (
                "sign" if isinstance(node.op, ast.Add | ast.Sub) else "factor",
                ast.BinOp(node.left, turned(), node.right),
            )
        if isinstance(node.op, ast.Add | ast.Sub) and not _is_text(node):
            yield "omission", node.left
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield "sign", node.operand
    elif isinstance(node, ast.Constant) and isinstance(node.value, float) and node.value:
        yield "factor", ast.Constant(2 * node.value)
    elif isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant):
        if isinstance(node.slice.value, int):
            other = node.slice.value - 1 if node.slice.value > 0 else node.slice.value + 1
            yield "index", ast.Subscript(node.value, ast.Constant(other), node.ctx)
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        if shifted := _SHIFTED.get(type(node.ops[0])):
            yield "comparison", ast.Compare(node.left, [shifted()], node.comparators)
    elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        called = ast.unparse(node.value.func)
        if "_check" in called:
            yield "omission", ast.Pass()


def _is_text(node: ast.BinOp) -> bool:
    """Whether an operand is a string or a type: `a | b` and texts are no kernels."""
    parts = (node.left, node.right)
    return any(isinstance(p, ast.JoinedStr | ast.Tuple | ast.List) for p in parts) or any(
        isinstance(p, ast.Constant) and isinstance(p.value, str) for p in parts
    )


def mutants(file: Path) -> list[Mutant]:
    """Every change that may be drawn in a file."""
    source = file.read_text(encoding="utf-8")
    lines, found = source.splitlines(keepends=True), []
    for node in _kernels(ast.parse(source)):
        for kind, other in changes(node):
            start, end = _place(lines, node)
            new = ast.unparse(ast.fix_missing_locations(copy.deepcopy(other)))
            new = new if isinstance(node, ast.Expr) else f"({new})"
            before, text = source[start:end], source[:start] + new + source[end:]
            name = file.relative_to(ROOT).as_posix()
            found.append(Mutant(name, node.lineno, kind, before, new, text))  # type: ignore
    return found


def _kernels(tree: ast.Module) -> Iterator[ast.AST]:
    """Nodes inside functions, without annotations, decorators, defaults and raised errors."""
    stack: list[tuple[ast.AST, bool]] = [(tree, False)]
    while stack:
        node, inside = stack.pop()
        if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr):
            continue
        if inside:
            yield node
        if isinstance(node, ast.FunctionDef | ast.Lambda):
            if isinstance(node, ast.FunctionDef) and node.name in ("_text", "__repr__"):
                continue
            body = node.body if isinstance(node.body, list) else [node.body]
            stack += [(child, True) for child in reversed(body)]
        elif isinstance(node, ast.AnnAssign):
            stack += [(node.value, inside)] if node.value is not None else []
        else:
            stack += [(child, inside) for child in reversed(list(ast.iter_child_nodes(node)))]


def _place(lines: list[str], node: ast.AST) -> tuple[int, int]:
    """Where the source of a node begins and ends, in characters."""

    def at(line: int, column: int) -> int:
        text = lines[line - 1].encode()[:column].decode()
        return sum(len(x) for x in lines[: line - 1]) + len(text)

    one: ast.expr = node  # type: ignore[assignment]
    assert one.end_lineno is not None and one.end_col_offset is not None
    return at(one.lineno, one.col_offset), at(one.end_lineno, one.end_col_offset)


def drawn(rooms: list[str], count: int, seed: int) -> list[Mutant]:
    """`count` mutants, as many from every room as from another."""
    draw, every = random.Random(seed), []
    for room in rooms:
        files = sorted(f for f in (ROOT / room).rglob("*.py") if f.name != "__init__.py")
        found = [mutant for file in files for mutant in mutants(file)]
        every.append(draw.sample(found, min(len(found), -(-count // len(rooms)))))
    rows = [m for turn in zip(*every, strict=False) for m in turn]
    return rows[:count]


def survives(mutant: Mutant, copy_of: Path, workers: int, wide: bool) -> bool:
    """Whether the tests of its room pass with the mutant in place, and then, if `wide`, its
    derivatives and the stress cases."""
    target, tests = copy_of / mutant.file, copy_of / "tests"
    kept = target.read_text(encoding="utf-8")
    room = next(r for r in ROOMS if mutant.file.startswith(r))
    files = sorted({f for p in ROOMS[room] for f in tests.glob(f"{p}.py")})
    order = sorted(files, key=lambda f: Path(mutant.file).stem not in f.read_text())
    target.write_text(mutant.text, encoding="utf-8")
    try:
        floor = f"{Path(room).name}- or stress"
        alive = _pass(order, copy_of, workers)
        return alive and (
            not wide
            or _pass([tests / "derivatives", tests / "stress", "-k", floor], copy_of, workers)
        )
    finally:
        target.write_text(kept, encoding="utf-8")


def _pass(what: Sequence[Path | str], copy_of: Path, workers: int) -> bool:
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", str(workers), "--dist",
               "load", "-p", "no:cacheprovider", *map(str, what)]  # fmt: skip
    path = os.pathsep.join(str(copy_of / part) for part in ("", "hardware", "hardware/pi"))
    try:
        done = subprocess.run(
            command,
            cwd=copy_of,
            env={**os.environ, "PYTHONPATH": path},
            timeout=LIMIT,
            capture_output=True,
            check=False,
        )
        return done.returncode == 0
    except subprocess.TimeoutExpired:
        return False  # a loop without end is seen


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draw", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--room", action="append", choices=list(ROOMS))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--skip", type=int, default=0, help="leave out the first of the draw")
    parser.add_argument("--narrow", action="store_true", help="the tests of its room alone")
    parser.add_argument("--list", action="store_true")
    options = parser.parse_args()
    chosen = drawn(options.room or list(ROOMS), options.draw, options.seed)[options.skip :]
    if options.list:
        print(*(mutant.name for mutant in chosen), sep="\n")
        return 0
    left = []
    with tempfile.TemporaryDirectory() as folder:
        copy_of = Path(folder) / "project"
        ignored = shutil.ignore_patterns(".git", ".venv*", "out", "results", "__pycache__")
        shutil.copytree(ROOT, copy_of, ignore=ignored)
        for number, mutant in enumerate(chosen, options.skip + 1):
            start = time.perf_counter()
            alive = survives(mutant, copy_of, options.workers, not options.narrow)
            left += [mutant] if alive else []
            seconds = time.perf_counter() - start
            word = "SURVIVES" if alive else "seen"
            print(f"{number:3} {word:8} {seconds:5.0f} s  {mutant.name}", flush=True)
    open_ones = [m for m in left if f"{m.file} {m.change}" not in EQUIVALENT]
    equal = len(left) - len(open_ones)
    print(f"{len(chosen)} mutants, {len(left)} survive, {equal} of them equivalent")
    return 1 if len(open_ones) > 3 else 0


if __name__ == "__main__":
    raise SystemExit(main())
