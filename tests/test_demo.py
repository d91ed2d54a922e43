"""The main job on a coarse mesh: numbers hold, results are complete, input is checked."""

import json

import pytest

from sorojax.cli import demo
from sorojax.cli.demo.job import _all_or_nothing
from sorojax.cli.main import main

FILES = {
    "actuator.gif", "backbones.png", "deformed.png", "loop.png", "modes.png",
    "report.html", "result.json", "rubber.png",
}  # fmt: skip


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "out"
    assert demo.run(folder, quick=True) == 0
    return folder


def test_all_results_are_there_and_nothing_else(out):
    assert {file.name for file in out.iterdir()} == FILES
    assert {file.name for file in out.parent.iterdir()} == {"out"}
    page = (out / "report.html").read_text()
    assert page.count("data:image/") == len(FILES) - 2
    assert 'src="http' not in page and 'href="http' not in page


def test_every_number_with_a_bar_holds(out):
    result = json.loads((out / "result.json").read_text())
    barred = {
        f"{section}: {name}": number["holds"]
        for section, rows in result.items()
        if section != "seconds"
        for name, number in rows.items()
        if number["bar"]
    }
    assert len(barred) == 5 and all(barred.values()), barred


def test_the_loop_follows_its_reference(out):
    loop = json.loads((out / "result.json").read_text())["loop"]
    assert loop["rms tracking error"]["value"] < 6  # deg, in 2 s for all three moves
    assert loop["largest bending"]["value"] > 30


def test_the_error_has_a_slope_by_every_dimension_and_gain(out):
    rows = json.loads((out / "result.json").read_text())["loop gradient"]
    slopes = {name: row for name, row in rows.items() if name.startswith("d error / d ")}
    assert len(slopes) == 7 + 4 and all(row["value"] != 0 for row in slopes.values())
    assert slopes["d error / d gap"]["unit"] == "deg per mm"
    assert slopes["d error / d derivative"]["unit"] == "deg per kPa s/rad"


def test_a_folder_of_other_files_is_left_alone(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("dear")
    assert main(["demo", "--quick", "--out", str(tmp_path)]) == 2
    assert "holds other files" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_failure_while_writing_leaves_the_old_results_and_nothing_else(tmp_path):
    out = tmp_path / "out"
    for number in (1, 2):
        with _all_or_nothing(out) as folder:
            (folder / "result.json").write_text(str(number))
    with pytest.raises(OSError, match="disk full"), _all_or_nothing(out) as folder:
        (folder / "result.json").write_text("3")
        raise OSError("disk full")
    assert [file.name for file in tmp_path.iterdir()] == ["out"]
    assert (out / "result.json").read_text() == "2"
