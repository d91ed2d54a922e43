"""The gallery shows every example, its picture, and what was measured beside the paper."""

import html
import json
import re
import subprocess
import sys

import pytest
from PIL import Image

from tests.scripts import ROOT

FOLDER = ROOT / "examples"
BUILD = FOLDER / "gallery" / "build.py"
SCRIPTS = sorted(FOLDER.glob("[0-9][0-9]_*.py"))
MOVING = {"04", "12", "13", "14", "15", "16", "20", "21", "22", "23", "24"}
MOVING |= {"30", "31", "32", "40", "41", "42", "43", "44"}
SCRIPT = '''"""A spring: how far it goes.

A second paragraph with <signs>.
"""


def main(quick=False):
    return {"way [mm]": 1 / 3 if quick else 2.5, "springs": 4}
'''
BROKEN = '''"""One that fails."""


def main():
    raise ValueError("no such spring")
'''


def build(*arguments):
    command = [sys.executable, str(BUILD), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.fixture(scope="module")
def written():
    done = build()
    assert done.returncode == 0, done.stderr
    return (FOLDER / "gallery" / "index.html").read_text()


def test_the_page_is_whole_and_static(written):
    for file in SCRIPTS:
        assert f'<section id="{file.stem}">' in written
    links = [link for link in re.findall(r'(?:src|href)="([^"]+)"', written) if link[0] != "#"]
    assert len(links) > len(SCRIPTS)
    for link in links:
        assert (FOLDER / "gallery" / html.unescape(link)).exists(), link
    shown = re.sub(r"<pre>.*?</pre>", "", written, flags=re.S)
    assert "http" not in shown and "<script" not in shown and "url(" not in shown


def test_every_picture_has_its_place(written):
    numbered = [p for p in FOLDER.glob("[0-9][0-9]_*.png")]
    assert numbered
    for picture in numbered:
        assert f'<img src="../{picture.name}"' in written


def test_what_moves_has_a_film_that_takes_the_place_of_its_picture(written):
    films = sorted(FOLDER.glob("*.webp"))
    assert {film.stem[:2] for film in films} >= MOVING
    for film in films:
        image = Image.open(film)
        assert image.n_frames >= 20, film
        image.seek(image.n_frames - 1)
        image.load()
        length = image.info["timestamp"] + image.info["duration"]  # of the last frame too
        assert 2500 <= length <= 8000, film
        assert film.stat().st_size < 600e3, film
        picture = film.with_suffix(".png")
        assert picture.exists() and "save(file.with_suffix(" in drawing(film)
        card = written.partition(f'<section id="{film.stem}">')[2].partition("</section>")[0]
        places = [card.find(f'src="../{file.name}"') for file in (picture, film)]
        assert 0 < places[0] < card.find("</summary>") < places[1]
    assert sum(film.stat().st_size for film in films) < 7e6


def drawing(film):
    """The script that draws a film."""
    return film.with_suffix(".py").read_text().replace("Path(file)", "file")


def test_numbers_of_the_paper_stand_beside_measured_ones():
    paper = json.loads((FOLDER / "gallery" / "paper.json").read_text())
    for name, entry in paper.items():
        file = FOLDER / "gallery" / "numbers" / f"{name}.json"
        compared = {*entry.get("numbers", ()), *entry.get("asked", ())}
        if compared and file.exists():
            assert compared <= set(json.loads(file.read_text())["numbers"]), name


def test_figures_and_contradictions_of_the_paper_are_named(written):
    """The figures of an example are those whose captions show it; none belongs to two."""
    paper = json.loads((FOLDER / "gallery" / "paper.json").read_text())
    figures = []
    for entry in paper.values():
        if "section" in entry:
            first, *last = map(int, re.findall(r"\d+", entry["section"].partition("figure")[2]))
            figures += range(first, (last or [first])[0] + 1)
            assert f"paper {entry['section']}<" in written
        assert html.escape(entry.get("note", "")) in written
    assert sorted(figures) == [4, 5, *range(7, 10), *range(12, 37)]
    assert "12.5 %" in paper["12_buckling"]["note"]
    assert "<th>ours</th><th>paper</th><th>asked</th><th>kind</th>" in written


def test_most_numbers_have_a_kind_and_every_kind_has_numbers(written):
    paper = json.loads((FOLDER / "gallery" / "paper.json").read_text())
    without, count = [], 0
    for file in (FOLDER / "gallery" / "numbers").glob("*.json"):
        kinds = paper.get(file.stem, {}).get("kinds", {})
        assert set(kinds) <= {"calibrated", "predicted", "check"}
        names = json.loads(file.read_text())["numbers"]
        starts = [start for each in kinds.values() for start in each]
        assert len(set(starts)) == len(starts), file.stem
        for start in starts:
            assert any(name.startswith(start) for name in names), (file.stem, start)
        without += [name for name in names if not name.startswith(tuple(starts))]
        count += len(names)
    assert len(without) < 0.1 * count, without
    row = written.partition("<td>frequency of the gait [Hz]</td>")[2].partition("</tr>")[0]
    assert row.endswith("<td>calibrated</td>")
    row = written.partition("<td>frequency, slope 25 deg [Hz]</td>")[2].partition("</tr>")[0]
    assert row.endswith("<td>predicted</td>")


def test_a_new_script_is_found_measured_and_shown(tmp_path):
    (tmp_path / "31_spring.py").write_text(SCRIPT)
    (tmp_path / "31_spring.png").write_bytes(b"")
    (tmp_path / "32_broken.py").write_text(BROKEN)
    (tmp_path / "gallery").mkdir()
    spring = {"section": "II", "numbers": {"way [mm]": "3 < x", "mass": "1"}}
    paper = {"31_spring": spring | {"asked": {"springs": "5"}, "note": "Ours & theirs."}}
    (tmp_path / "gallery" / "paper.json").write_text(json.dumps(paper))
    done = build("--folder", tmp_path, "--run")
    assert done.returncode == 1 and "no such spring" in done.stderr
    made = json.loads((tmp_path / "gallery" / "numbers" / "31_spring.json").read_text())
    assert made["numbers"] == {"way [mm]": 2.5, "springs": 4} and not made["quick"]
    assert made["machine"] and "JAX" in made["versions"]
    text = (tmp_path / "gallery" / "index.html").read_text()
    assert "<td>way [mm]</td><td>2.5</td><td>3 &lt; x</td>" in text
    assert "<td>mass</td><td>-</td><td>1</td>" in text and "paper II" in text
    assert "<td>springs</td><td>4</td><td></td><td>5</td>" in text
    assert "<p>Ours &amp; theirs.</p>" in text
    assert '<img src="../31_spring.png"' in text and "&lt;signs&gt;" in text
    assert "not measured yet" in text  # the one that failed
    again = build("--folder", tmp_path, "--run", "31", "--quick")
    assert (
        again.returncode == 0
        and "quick mode" in (tmp_path / "gallery" / "index.html").read_text()
    )
