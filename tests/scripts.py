"""The scripts of `examples`, as functions."""

import ast
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent


def main_of(name: str) -> Callable[..., dict[str, Any]]:
    """The function `main` of an example, by the name of its file."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main


def user_code(name: str) -> int:
    """Lines of an example that a user has to write."""
    return written_lines(ROOT / "examples" / f"{name}.py")


def written_lines(path: Path) -> int:
    """Lines of a file but imports, docstrings, comments, blank lines, a function that draws
    and the command line."""
    text = path.read_text()
    tree, left_out = ast.parse(text), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef):
            first = node.body[0]
            if ast.get_docstring(node) is not None:
                left_out |= _lines(first)
    for node in tree.body:
        is_picture = isinstance(node, ast.FunctionDef) and node.name in ("draw", "plot")
        is_command = isinstance(node, ast.If) and "__name__" in ast.dump(node.test)
        if is_picture or is_command or isinstance(node, ast.Import | ast.ImportFrom):
            left_out |= _lines(node)
    return sum(
        bool(line.strip()) and not line.strip().startswith("#") and number not in left_out
        for number, line in enumerate(text.splitlines(), 1)
    )


def _lines(node: Any) -> set[int]:
    return set(range(node.lineno, node.end_lineno + 1))
