"""Python of the README and of the notebooks as files, for the type checker:

    python -m tests.user_code

Writes `out/user_code/*.py`, which `make lint` checks as a user's code is.
"""

import json
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "out" / "user_code"


def programs() -> dict[str, str]:
    """Source by name: all Python blocks of the README in a row, and each notebook's cells."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    found = {"readme": "\n".join(blocks)}
    for file in sorted((ROOT / "examples" / "notebooks").glob("*.ipynb")):
        cells = json.loads(file.read_text())["cells"]
        code = ("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
        found[file.stem] = "\n\n".join(code)
    return found


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, source in programs().items():
        (FOLDER / f"{name}.py").write_text(source + "\n")
    print(f"wrote {FOLDER.relative_to(ROOT)}")
