"""Run the notebooks of this folder in a kernel and store them with their outputs.

`python examples/notebooks/execute.py [NAME ...]` needs nbclient, nbformat and ipykernel. What
differs from run to run without need (times of execution, numbers of outputs) is not stored.
"""

import base64
import io
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
MOST = 300_000  # bytes of a notebook with its outputs
WIDE, COLOURS = 900, 200  # of the pictures that are stored
TIME_LIMIT = 600  # s per cell


def execute(file: Path) -> float:
    """Run one notebook, write it back, and return how long it took [s]."""
    import nbformat
    from nbclient import NotebookClient

    book = nbformat.read(file, as_version=4)
    start = time.perf_counter()
    client = NotebookClient(
        book,
        timeout=TIME_LIMIT,
        record_timing=False,
        resources={"metadata": {"path": str(HERE.parent.parent)}},
    )
    client.execute()
    spent = time.perf_counter() - start
    book.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    for cell in book.cells:
        if cell.cell_type == "code":
            cell.outputs = [_small(o) for o in cell.outputs if not _is_noise(o)]
    text = nbformat.writes(book) + "\n"
    if len(text.encode()) > MOST:
        raise ValueError(
            f"{file.name}: {len(text.encode())} bytes with its outputs, need {MOST} or less. "
            "Show fewer or smaller pictures."
        )
    file.write_text(text)
    return spent


def _small(output):
    """The same with a picture of few colours, a third as large."""
    from PIL import Image

    data = output.get("data", {})
    if "image/png" in data:
        picture = Image.open(io.BytesIO(base64.b64decode(data["image/png"]))).convert("RGB")
        picture.thumbnail((WIDE, WIDE))
        packed = io.BytesIO()
        picture.quantize(COLOURS, dither=Image.Dither.NONE).save(packed, "PNG", optimize=True)
        data["image/png"] = base64.b64encode(packed.getvalue()).decode()
    return output


def _is_noise(output) -> bool:
    """What a run says on the side: progress bars and warnings."""
    if output.output_type == "stream":
        return output.name == "stderr"
    return "<progress" in str(output.get("data", {}).get("text/html", ""))


def main(names: list[str]) -> int:
    files = [HERE / f"{name}.ipynb" for name in names] or sorted(HERE.glob("*.ipynb"))
    for file in files:
        spent = execute(file)
        print(f"{file.name:<24} {spent:5.1f} s  {file.stat().st_size / 1e3:4.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
