"""The cases that exist: one file each, found by name, described by its docstring."""

import ast
import importlib.util
from pathlib import Path
from types import ModuleType

HERE = Path(__file__).parent
CASES = HERE / "cases"


def cases(folder: Path = CASES) -> dict[str, Path]:
    """Files by case name: `rod_acceleration.py` holds `rod.acceleration`."""
    files = [path for path in sorted(folder.glob("*_*.py")) if path.name[0] != "_"]
    return {path.stem.replace("_", ".", 1): path for path in files}


def description(path: Path) -> str:
    """First line of the docstring, read without importing the case."""
    text = ast.get_docstring(ast.parse(path.read_text())) or ""
    return text.partition("\n")[0]


def workers(path: Path) -> int:
    """Threads of JAX that a case asks for by `WORKERS = 1`, two otherwise; read likewise."""
    for statement in ast.parse(path.read_text()).body:
        if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == "WORKERS":
            return ast.literal_eval(statement.value)
    return 2


def load(name: str, path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"case_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ValueError(f"benchmarks: {path} is no Python file, need one for {name}.")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
