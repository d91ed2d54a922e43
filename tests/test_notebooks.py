"""Every notebook runs and gives what it stores.

Its cells run in this process, in one namespace: a kernel for each would take a start of JAX
each, and packages that nothing else here needs. Where nbclient and ipykernel are installed one
notebook runs in a real kernel too.
"""

import ast
import json

import jax
import pytest

from sorojax import silent
from tests.scripts import ROOT

FOLDER = ROOT / "examples" / "notebooks"
NAMES = ("batched_sweep", "design_loop", "estimator", "learning")
SLOW = ("learning",)
MOST = 300_000  # bytes


def cells_of(name):
    book = json.loads((FOLDER / f"{name}.ipynb").read_text())
    return [cell for cell in book["cells"] if cell["cell_type"] == "code"]


def shown(cells):
    """All text that the outputs hold."""
    text = ""
    for output in (o for cell in cells for o in cell["outputs"]):
        text += "".join(output.get("text", []))
        text += "".join(output.get("data", {}).get("text/plain", []))
    return text


def run(cells):
    """Run cells one after the other; the names they leave, and the values they end with."""
    names, ends = {"__name__": "__main__"}, []
    for cell in cells:
        body = ast.parse("".join(cell["source"])).body
        last = body.pop() if body and isinstance(body[-1], ast.Expr) else None
        exec(compile(ast.Module(body, []), "notebook", "exec"), names)
        if last is not None:
            ends.append(eval(compile(ast.Expression(last.value), "notebook", "eval"), names))
    return names, ends


def test_the_folder_holds_these_notebooks():
    assert sorted(file.stem for file in FOLDER.glob("*.ipynb")) == sorted(NAMES)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n in SLOW)) for n in NAMES]
)
def test_a_notebook_runs_and_gives_what_it_stores(name):
    file, cells = FOLDER / f"{name}.ipynb", cells_of(name)
    assert file.stat().st_size < MOST
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert not [o for o in outputs if o["output_type"] == "error"]
    assert sum("image/png" in o.get("data", {}) for o in outputs) >= 2
    with silent(), jax.numpy_dtype_promotion("standard"):  # optax mixes integers and floats
        names, ends = run(cells)
    pictures = [end for end in ends if getattr(end, "_repr_png_", lambda: None)()]
    assert len(pictures) == sum("image/png" in o.get("data", {}) for o in outputs)
    stored = _numbers(cells)
    assert stored == pytest.approx(names["numbers"], rel=0.02)
    CHECKS[name](names["numbers"])


def _numbers(cells):
    """The dictionary that the cell of `numbers` stores."""
    (cell,) = [c for c in cells if "".join(c["source"]).endswith("\nnumbers")]
    return ast.literal_eval("".join(cell["outputs"][-1]["data"]["text/plain"]))


def _design(numbers):
    assert numbers["deflection on a finer mesh [mm]"] == pytest.approx(5, rel=0.02)
    assert numbers["area of rubber, last [-]"] < numbers["area of rubber, first [-]"]


def _sweep(numbers):
    assert numbers["members that succeeded"] == numbers["members"] == 576
    best, closer = (numbers[f"error, best of the {k} [deg]"] for k in ("grid", "second grid"))
    assert closer <= best < 0.2 * numbers["error, worst of the grid [deg]"]


def _estimator(numbers):
    assert numbers["tip, rms while seen [mm]"] < 1
    assert numbers["tip, worst while hidden [mm]"] < 10


def _learning(numbers):
    """Both ways learn; gradients take a twentieth of the steps."""
    assert numbers["PPO: reaches more than half"] and numbers["gradients: reach more than half"]
    assert numbers["gradients: thousand steps"] < 0.2 * numbers["PPO: thousand steps"]


CHECKS = {
    "design_loop": _design,
    "batched_sweep": _sweep,
    "estimator": _estimator,
    "learning": _learning,
}


def test_a_kernel_runs_a_notebook():
    for package in ("nbclient", "nbformat", "ipykernel"):
        pytest.importorskip(package, reason=f"{package} is not installed, cells run without it")
    import nbformat
    from nbclient import NotebookClient

    book = nbformat.read(FOLDER / "estimator.ipynb", as_version=4)
    NotebookClient(book, timeout=300, resources={"metadata": {"path": str(ROOT)}}).execute()
    assert "median of an update" in shown(
        [dict(cell) for cell in book.cells if cell.cell_type == "code"]
    )
