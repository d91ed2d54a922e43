"""The house: what may import what, what an import costs, how long a file may be."""

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import sorojax

ROOT = Path(__file__).parent.parent
CORE, HARDWARE = ROOT / "sorojax", ROOT / "hardware"
BASEMENT = {
    "units", "_types", "_check", "_display", "_edit", "_progress", "_cache", "_jax",
    "_arguments", "_explain", "_kinds", "_mappings", "_signatures",
}  # fmt: skip
FLOOR = {
    "math": 0,
    **dict.fromkeys(("sdf", "material"), 1),
    **dict.fromkeys(("mesh", "contact"), 2),
    **dict.fromkeys(("fem", "rod"), 3),
    **dict.fromkeys(("systems", "reduction", "coupling"), 4),
    **dict.fromkeys(("design", "robots"), 5),
    "io": 6,
    **dict.fromkeys(("view", "vision", "sweep"), 7),
    **dict.fromkeys(("cli", "envs"), 8),
    "__main__": 9,
}
NOT_PROMISED = (
    "jax._src", "jax.core", "jax.extend", "jax.interpreters", "jax.experimental", "jax.lib",
    "jaxlib",
)  # fmt: skip
CALLBACKS_AND_OPTIONS = {
    "pure_callback",
    "io_callback",
    "compiler_options",
    "Primitive",
    "set_xla_metadata",
}
ONLY_WHERE_USED = {
    "cv2",
    "pyvista",
    "skimage",
    "meshio",
    "matplotlib",
    "mujoco",
    "pyrealsense2",
}
MAX_LINES = 600
LONGER: set[str] = set()  # files of numbers and nothing else


def sources(*roots: Path) -> list[Path]:
    return sorted(path for root in roots for path in root.rglob("*.py"))


def imports(path: Path, package_root: Path, inside_functions: bool = True) -> Iterator[str]:
    """Dotted names that a file imports; `from a import b` counts as `a.b`."""
    here = path.relative_to(package_root).with_suffix("").parts
    for node in walk(ast.parse(path.read_text()), inside_functions):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level] if node.level else ()
            module = (*base, *(node.module or "").split("."))
            for alias in node.names:
                yield ".".join(part for part in (*module, alias.name) if part)


def walk(node: ast.AST, inside_functions: bool) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(node):
        is_function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
        is_typing = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test)
        if not inside_functions and (is_function or is_typing):
            continue
        yield child
        yield from walk(child, inside_functions)


def room(path: Path) -> str:
    return path.relative_to(CORE).with_suffix("").parts[0]


def room_of(path: Path) -> str:
    """The package of the core that a file lies in, or what else holds it."""
    return room(path) if path.is_relative_to(CORE) else path.relative_to(ROOT).parts[0]


def wrong_imports(path: Path) -> list[str]:
    """Imports of a room on the same floor or above, or of a room without a floor."""
    mine = room(path)
    floor = -1 if mine in BASEMENT else FLOOR[mine]
    found = []
    for name in imports(path, ROOT):
        top, _, rest = name.partition(".")
        other = rest.partition(".")[0]
        if top == "sorojax_hardware":
            found.append(f"{path.relative_to(ROOT)} imports {name}")
        if top == "sorojax" and other in FLOOR and other != mine and FLOOR[other] >= floor:
            found.append(f"{path.relative_to(ROOT)} imports {name}")
    return found


def test_every_room_has_a_floor():
    rooms = {room(path) for path in sources(CORE)} - {"__init__"}
    assert rooms <= FLOOR.keys() | BASEMENT, rooms - FLOOR.keys() - BASEMENT


def test_imports_go_down_only():
    files = [path for path in sources(CORE) if room(path) != "__init__"]
    assert [line for path in files for line in wrong_imports(path)] == []


@pytest.mark.parametrize(
    "line",
    [
        "import sorojax.fem",
        "from sorojax import fem",
        "from sorojax.fem import solve",
        "from ..fem.solve import solve",
        "from .. import fem",
        "def late():\n    from sorojax.rod import rod",
        "import sorojax_hardware",
    ],
)
def test_the_import_rule_catches(line, tmp_path, monkeypatch):
    file = tmp_path / "sorojax" / "sdf" / "case.py"
    file.parent.mkdir(parents=True)
    file.write_text(line)
    here = sys.modules[__name__]
    monkeypatch.setattr(here, "ROOT", tmp_path)
    monkeypatch.setattr(here, "CORE", tmp_path / "sorojax")
    assert len(wrong_imports(file)) == 1


def test_a_folder_has_at_most_fourteen_modules():
    folders = [CORE, *(d for d in CORE.rglob("*") if d.is_dir())]
    assert not [d.name for d in folders if len(list(d.glob("*.py"))) > 14]


def test_a_checker_sees_arguments_in_their_order():
    """`eqx.AbstractVar` is a field for type checkers, the first of the signature they see:
    `if TYPE_CHECKING:` with `ClassVar` is none."""
    found = [f.name for f in CORE.rglob("*.py") if "AbstractVar[" in f.read_text()]
    assert not found


def test_hardware_knows_nothing_of_the_core():
    found = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in sources(HARDWARE)
        for name in imports(path, HARDWARE)
        if name.partition(".")[0] in ("sorojax", "jax", "equinox", "diffrax")
    ]
    assert found == []


def test_heavy_libraries_load_only_where_used():
    found = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in sources(CORE, HARDWARE)
        for name in imports(path, ROOT, inside_functions=False)
        if name.partition(".")[0] in ONLY_WHERE_USED
    ]
    assert found == []


def not_promised(path: Path) -> list[str]:
    """Where a file touches what JAX does not promise, host callbacks or compiler options."""
    tree = ast.parse(path.read_text())
    names = [(0, name) for name in imports(path, ROOT)]
    for node in ast.walk(tree):
        line = getattr(node, "lineno", 0)
        if isinstance(node, ast.Attribute):
            names.append((line, ast.unparse(node)))
        elif isinstance(node, ast.keyword):
            names.append((line, node.arg or ""))
    return [
        f"{path.relative_to(ROOT)}:{line} {name}"
        for line, name in names
        if any(name == start or name.startswith(start + ".") for start in NOT_PROMISED)
        or name.rpartition(".")[2] in CALLBACKS_AND_OPTIONS
        or name.startswith("jax.debug.")
    ]


def test_one_room_touches_what_jax_does_not_promise():
    outside = [path for path in sources(CORE, HARDWARE) if room_of(path) != "_jax"]
    assert [line for path in outside for line in not_promised(path)] == []
    assert any(not_promised(path) for path in sources(CORE / "_jax"))


@pytest.mark.parametrize(
    "line",
    [
        "from jax._src import core",
        "import jax.core",
        "from jax.extend.core import Primitive",
        "import jax\nx = jax.core.Tracer",
        "import jax\njax.pure_callback(f, s)",
        "import jax\njax.debug.callback(f)",
        "import jax\njax.jit(f, compiler_options={})",
        "from jax.interpreters import mlir",
        "def late():\n    from jax.experimental import io_callback",
    ],
)
def test_the_rule_of_that_room_catches(line, tmp_path, monkeypatch):
    file = tmp_path / "sorojax" / "sdf" / "case.py"
    file.parent.mkdir(parents=True)
    file.write_text(line)
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    assert not_promised(file)


def test_each_file_of_that_room_says_what_it_rests_on():
    plain = {"__init__.py", "optional.py", "versions.py", "in_kernels.py"}
    for path in sources(CORE / "_jax"):
        text = ast.get_docstring(ast.parse(path.read_text())) or ""
        assert path.name in plain or "Rests on" in text, path.name


def test_files_are_short():
    lengths = {
        str(path.relative_to(ROOT)): len(path.read_text().splitlines())
        for path in sources(CORE, HARDWARE, ROOT / "benchmarks")
    }
    long = {name: n for name, n in lengths.items() if n > MAX_LINES and name not in LONGER}
    assert long == {}
    assert lengths.keys() >= LONGER


def test_nothing_is_a_stub():
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in sources(CORE, HARDWARE)
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Name) and node.id == "NotImplementedError"
    ]
    assert found == []


IMPORT_COST = f"""
import time
start = time.perf_counter()
import jax, equinox, diffrax
below = time.perf_counter() - start
flags = dict(jax.config.values)
start = time.perf_counter()
import sorojax
seconds = time.perf_counter() - start
import sys
floors = [getattr(sorojax, name) for name in dir(sorojax)]
changed = [name for name, value in jax.config.values.items() if value != flags.get(name)]
loaded = sorted({ONLY_WHERE_USED!r} & sys.modules.keys())
print(seconds, below, changed, loaded, sep=";")
"""


def test_import_is_cheap_and_sets_no_flag():
    shares = []
    for _ in range(3):
        done = subprocess.run(
            [sys.executable, "-c", IMPORT_COST],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        )
        seconds, below, changed, loaded = done.stdout.strip().split(";")
        assert (changed, loaded) == ("[]", "[]")
        shares.append(float(seconds) / float(below))
    # in seconds it is the benchmark cli.import
    assert min(shares) < 1.0, f"import sorojax costs {min(shares):.2f} of what lies below it"


HIDDEN = """
import importlib, pkgutil, sys
for floor in sys.argv[1:]:
    package = importlib.import_module("sorojax." + floor)
    public = {name: value for name, value in vars(package).items() if callable(value)}
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(package.__name__ + "." + module.name)
    for name, value in public.items():
        if getattr(package, name) is not value:
            print(package.__name__ + "." + name)
"""


def test_no_module_hides_a_public_name():
    """A module is set on its package when it is first imported, over a function of its name."""
    floors = [name for name in FLOOR if (CORE / name).is_dir()]
    done = subprocess.run(
        [sys.executable, "-c", HIDDEN, *floors],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == ""


def packages() -> list[ModuleType]:
    names = sorted(path.parent.name for path in CORE.glob("*/__init__.py"))
    return [
        importlib.import_module(f"sorojax.{name}") for name in names if name in sorojax.__all__
    ]


def test_a_package_shows_its_public_names_only():
    for package in packages():
        assert dir(package) == sorted(package.__all__), package
        found = [name for name in package.__all__ if not hasattr(package, name)]
        assert not found, (package, found)


def test_a_class_has_one_public_path():
    paths: dict[type, list[str]] = {}
    for package in (sorojax, *packages()):
        for name in package.__all__:
            value = getattr(package, name)
            if isinstance(value, type):
                paths.setdefault(value, []).append(f"{package.__name__}.{name}")
    assert len(paths) > 200 and not [names for names in paths.values() if len(names) > 1]
