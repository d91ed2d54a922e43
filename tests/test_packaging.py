"""What a wheel holds, and what a package index shows of it."""

import re
import tomllib
from pathlib import Path

from hatchling.builders.wheel import WheelBuilder

import sorojax
from sorojax._jax.versions import TESTED
from sorojax_board.__main__ import INSTALLER, main

ROOT = Path(__file__).parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT, HATCH = PYPROJECT["project"], PYPROJECT["tool"]["hatch"]
README = (ROOT / "README.md").read_text()
PACKAGES = [ROOT / folder for folder in HATCH["build"]["targets"]["wheel"]["only-include"]]


def test_every_file_of_the_board_is_in_the_wheel():
    files = [path for path in (ROOT / "hardware" / "pi").rglob("*") if path.is_file()]
    outside = [f for f in files if not any(f.is_relative_to(folder) for folder in PACKAGES)]
    assert outside == [] and len(files) > 10


def test_the_board_finds_its_installer(capsys):
    assert main(["--installer"]) == 0
    assert capsys.readouterr().out == f"{INSTALLER}\n"
    files = {path.name for path in INSTALLER.iterdir()}
    assert files == {"board.json", "install.sh", "sorojax-board.service"}
    named = re.findall(r"\$here/([\w.-]+)", (INSTALLER / "install.sh").read_text())
    assert named and set(named) <= files


def test_the_builder_takes_packages_with_their_data():
    builder = WheelBuilder(str(ROOT))
    taken = {file.distribution_path for file in builder.recurse_included_files()}
    expected = {
        "sorojax_board/raspberry_pi/board.json",
        "sorojax_board/raspberry_pi/install.sh",
        "sorojax_board/raspberry_pi/sorojax-board.service",
        "sorojax/view/assets/viewer.html",
        "sorojax/_jax/versions.py",
        "sorojax/py.typed",
        "sorojax_hardware/py.typed",
    }
    assert expected <= taken
    tops = {path.partition("/")[0] for path in taken}
    assert tops == {"sorojax", "sorojax_board", "sorojax_hardware"}


def test_links_of_the_readme_lead_somewhere_on_an_index_too():
    text = README
    for rule in HATCH["metadata"]["hooks"]["fancy-pypi-readme"]["substitutions"]:
        text = re.sub(rule["pattern"], rule["replacement"], text)
    links = re.findall(r"\]\(([^)\s]+)\)", text)
    assert links and all(re.match("https://", link) for link in links), links
    ours = [link for link in links if PROJECT["urls"]["Source"] in link or "raw." in link]
    beside = [link.split("/main/")[1].partition("#") for link in ours]
    assert [name for name, *_ in beside if not (ROOT / name).exists()] == []
    for name, _, heading in beside:
        assert not heading or heading.replace("-", " ") in (ROOT / name).read_text().lower()
    assert all("raw." in link for link in re.findall(r"!\[[^]]*\]\(([^)]+)\)", text))


def test_the_readme_names_every_extra_and_the_versions():
    table = README[README.index("| extra |") : README.index("`sorojax info` tells")]
    named = set(re.findall(r"`(\w+)`(?=[^|]*\|[^|]*\|[^|]*\|\n)", table))
    assert named >= PROJECT["optional-dependencies"].keys()
    tested = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if ":: Python :: 3." in c]
    assert (
        f"Python {tested[0]} to {tested[-1]}, and JAX from {TESTED[0]} to {TESTED[-1]}"
        in README
    )
    assert f"version: {sorojax.__version__}" in (ROOT / "CITATION.cff").read_text()
