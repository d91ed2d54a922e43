"""The benchmark harness: cases by file, JSON lines, peers that are missing."""

import json
import subprocess
import sys
import xml.etree.ElementTree as xml
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import cold_peers, curves, discover, harness, memory, page, scaling, suite, svg
from benchmarks.__main__ import main
from benchmarks.discrete_rod import Bar, _ends as ends_of
from benchmarks.peers import call, row
from benchmarks.peers.call import status
from benchmarks.rows import KEYS, Row, Timing, line
from benchmarks.runner import run_case

CASE = '''"""A product, with and without a bar."""
import os

import jax.numpy as jnp

from benchmarks.harness import Row, measure
from benchmarks.peers import row

def rows():
    timing = measure(lambda x: x @ x, jnp.ones((8, 8)), repeats=3)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    settings = {"size": 8, "cores": cores, "NPROC": os.environ["NPROC"]}
    yield Row("sorojax", settings, **timing.columns(), error=1e-3, reference="exact", bar=9.0)
    yield Row("stock", settings, **timing.columns(), error=float("nan"))
    yield row("soromox", "acceleration", {}, lambda arrays: 0.0, "exact", nodes=8)
'''
BROKEN = '''"""Fails after its first row."""
from benchmarks.harness import Row

def rows():
    yield Row("sorojax", {"size": 1})
    raise RuntimeError("the matrix is singular")
'''


SLEEPY = '''"""A call that waits."""
import time

from benchmarks.harness import Row, measure_calls

def rows():
    yield Row("sorojax", {}, **measure_calls(lambda: time.sleep(0.1) or 0, 1).columns())
'''


SHORT = '''"""Of two sizes, one in a quick run."""
from benchmarks.harness import Row, quick

def rows():
    for size in (1,) if quick("size <2>") else (1, 2):
        yield Row("sorojax", {"size": size}, run_s=1.0)
    quick("size <2>")  # said once
'''


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SOROJAX_PEERS", str(tmp_path / "no peers"))
    (tmp_path / "cases").mkdir()
    (tmp_path / "cases" / "math_product.py").write_text(CASE)
    (tmp_path / "cases" / "math_broken.py").write_text(BROKEN)
    (tmp_path / "cases" / "math_short.py").write_text(SHORT)
    return tmp_path / "cases"


def run(folder, name, *options):
    file = folder.parent / "lines.json"
    status = main([name, *options, "--json", str(file), "--cases", str(folder)])
    return status, [json.loads(text) for text in file.read_text().splitlines()]


def test_list_names_every_case():
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", "--list"],
        cwd=Path(__file__).parent.parent,
        capture_output=True,
        text=True,
        check=True,
    )
    listed = dict(text.split(maxsplit=1) for text in done.stdout.splitlines())
    assert listed.keys() == discover.cases().keys()
    assert {"rod.acceleration", "rod.simulation"} <= listed.keys()


def test_a_case_writes_json_lines(folder):
    status, (ours, stock, peer) = run(folder, "math.product")
    assert status == 0
    assert all(tuple(x) == KEYS and x["case"] == "math.product" for x in (ours, stock, peer))
    assert ours["run_s_min"] <= ours["run_s"] <= ours["run_s_max"] and ours["compile_s"] > 0
    assert ours["holds"] is True and stock["holds"] is None
    assert stock["error"] is None  # NaN is no JSON
    assert ours["settings"] == {"size": 8, "cores": 1, "NPROC": "2", "bar_on": "run_s"}


def test_a_case_may_ask_for_one_worker(folder):
    (folder / "math_alone.py").write_text(CASE.replace("def rows", "WORKERS = 1\n\ndef rows"))
    assert run(folder, "math.alone")[1][0]["settings"]["NPROC"] == "1"


def test_a_missing_peer_is_a_row_with_its_reason(folder):
    peer = run(folder, "math.product")[1][-1]
    assert peer["code"] == "soromox" and peer["run_s"] is None and peer["holds"] is None
    assert "not installed" in peer["settings"]["reason"]


def test_a_failing_case_keeps_its_rows_and_says_why(folder):
    status, (first, last) = run(folder, "math.broken")
    assert status == 1
    assert first["settings"] == {"size": 1}
    assert "the matrix is singular" in last["settings"]["reason"]


def test_a_case_that_hangs_is_ended(folder):
    (folder / "math_hang.py").write_text("import time\ntime.sleep(60)\n")
    (found,) = run_case("math.hang", folder / "math_hang.py", limit=3.0)
    assert found["settings"]["reason"] == "not finished after 3 s"


def test_cpu_seconds_leave_out_what_waits(folder, monkeypatch):
    (folder / "math_sleepy.py").write_text(SLEEPY)
    (clock,) = run(folder, "math.sleepy")[1]
    monkeypatch.setenv("SOROJAX_BENCH_CPU", "0")  # so that it is as before afterwards
    (cpu,) = run(folder, "math.sleepy", "--cpu")[1]
    assert clock["run_s"] >= 0.1 > 0.05 > cpu["run_s"]


def test_curves_are_drawn_from_the_recorded_run(tmp_path):
    """Every panel has its curves; the pictures are small and on the page."""
    lines = curves.read()
    for panels in curves.FIGURES.values():
        for panel in panels:
            found = curves.curves(panel, lines)
            assert any(len(points) > 1 for points in found.values()), panel.case
            assert len({curve.group for curve in found}) <= len(curves.COLOURS)
    page = (Path(__file__).parent.parent / "docs" / "benchmarks.md").read_text()
    for picture in curves.draw(lines, tmp_path):
        assert (curves.PICTURES / picture.name).stat().st_size < 200_000
        assert f"(pictures/{picture.name})" in page
    (statics,) = curves.FIGURES["rod_statics"]
    assert statics.curve({"settings": {"case": "roll-up"}}) is None  # an error of rounding only


def test_unknown_case_is_named(folder, capsys):
    assert main(["math.nothing", "--cases", str(folder)]) == 2
    assert "math.product" in capsys.readouterr().err


def test_a_peer_answers_arrays_and_times(folder, monkeypatch):
    home = folder.parent / "peers"
    (home / "soromox").mkdir(parents=True)
    (home / "soromox" / "status.json").write_text('{"ok": true, "version": "0"}')
    (home / "soromox.py").write_text(
        "import json, sys, pathlib, numpy as np\n"
        "folder = pathlib.Path(sys.argv[-1])\n"
        "x = np.load(folder / 'request.npz')['x']\n"
        "answer = {'compile_s': 1.0, 'runs': [3.0, 1.0, 2.0]}\n"
        "(folder / 'answer.json').write_text(json.dumps(answer))\n"
        "np.savez(folder / 'answer.npz', y=2 * x)\n"
    )
    monkeypatch.setenv("SOROJAX_PEERS", str(home))
    call = sys.modules["benchmarks.peers.call"]  # the package's `call` is its function
    assert call.interpreter("soromox").is_relative_to(home / "soromox")
    # this process's interpreter stands for that of the peer
    monkeypatch.setattr(call, "interpreter", lambda peer: Path(sys.executable))
    monkeypatch.setattr(call, "HERE", home)
    found = row("soromox", "double", {"x": 2.0}, lambda a: abs(a["y"] - 4), "exact", size=1)
    assert (found.run_s_min, found.run_s, found.run_s_max, found.error) == (1, 2, 3, 0)
    assert found.settings == {"size": 1, "version": "0"}


CHAIN = """
import json, os, pathlib, sys
import numpy as np
folder = pathlib.Path(sys.argv[-1])
kept = pathlib.Path(os.environ["JAX_COMPILATION_CACHE_DIR"]) / "kept"
seconds = [1.0 if kept.exists() else 5.0, 0.5]
kept.touch()
request = json.loads((folder / "request.json").read_text())
arrays = np.load(folder / "request.npz")
x, v, h, found = arrays["start"], 0 * arrays["start"], request["dt"] / 50, [arrays["start"]]
for k in range(50 * request["saves"]):
    v = v - h / 2 * arrays["chain"] @ x
    x = x + h * v
    v = v - h / 2 * arrays["chain"] @ x
    found += [x] if k % 50 == 49 else []
answer = {"seconds": seconds, "cpu": [second / 2 for second in seconds]}
(folder / "answer.json").write_text(json.dumps(answer))
np.savez(folder / "answer.npz", result=np.array(found))
"""


def test_first_calls_of_a_peer_with_an_empty_cache_and_a_filled_one(tmp_path, monkeypatch):
    """Its answer is held against the exact motion; without the peer there is a reason."""
    monkeypatch.setenv("SOROJAX_PEERS", str(tmp_path))
    task = cold_peers._chain("plain", 3, 0.1, 0.01, "motion")
    (none,) = cold_peers._peer(task)
    assert "not installed" in none.settings["reason"] and none.run_s is None
    (tmp_path / "diffrax").mkdir()
    (tmp_path / "diffrax" / "status.json").write_text('{"ok": true, "version": "0"}')
    (tmp_path / "diffrax.py").write_text(CHAIN)
    call = sys.modules["benchmarks.peers.call"]
    monkeypatch.setattr(call, "interpreter", lambda peer: Path(sys.executable))
    monkeypatch.setattr(call, "HERE", tmp_path)
    rows = list(cold_peers._peer(task))
    seconds = {row.settings["cache"]: row.run_s for row in rows}
    assert seconds == {"empty": 5.0, "filled": 1.0, "second call": 0.5}
    assert [row.settings["cpu_s"] for row in rows] == [2.5, 0.5, 0.25]
    assert all(row.holds and row.error is not None and row.error < 1e-4 for row in rows)
    wrong = next(cold_peers._peer(task._replace(wanted=1.01 * task.wanted)))
    assert wrong.holds is False


@pytest.mark.parametrize("bar_on, holds", [("run_s", True), ("error", False)])
def test_a_bar_is_on_time_or_on_error(bar_on, holds):
    found = Row("sorojax", run_s=1.0, error=3.0, bar=2.0, bar_on=bar_on)
    assert found.holds is holds
    assert Row("sorojax", bar=1.0).holds is False  # not measured is not met


def test_a_long_program_runs_once_and_keeps_its_answer():
    turns = []

    def scaled(x, count):
        jax.debug.callback(lambda: turns.append(count))
        return (count * x,)

    timing, found = harness.measure_once(scaled, jnp.ones(2), 3)
    jax.effects_barrier()
    assert turns == [3] and len(timing.runs) == 1 and timing.compile_s > 0
    assert found[0].tolist() == [3, 3]


def test_pyelastica_has_the_stiffness_and_inertia_that_it_is_given():
    """Ends of a short flight beside the discrete rod, and the tip of an arm that is turned."""
    if not status("pyelastica")["ok"]:
        pytest.skip("make peers PEERS=pyelastica")
    push = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    arrays = {
        "bar": np.array([1.0, 50.0, 50.0, 0.5, 1.0, 0.01]),
        "base": np.array([0.0, 1.0, 0.0]),
        "axes": np.eye(3),
        "wrench": push / 20,
        "times": np.array([0.0, 1.0]),
        "shares": np.array([1.0, 1.0]),
    }
    options = {"elements": 12, "share": 0.05, "duration": 0.4, "save_dt": 0.4, "repeats": 1}
    _, found = call("pyelastica", "flight", arrays, **options)
    rod = Bar(1.0, axial=50.0, bending=0.5, mass=1.0, rotary=0.01)
    whole = push[:3] / 20, push[3:] / 20
    want = ends_of(rod, arrays["base"], np.eye(3), lambda t: whole, np.array([0.4]), 12)
    moved = want - np.array([[0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])[None]
    assert np.abs(found["ends"] - want).max() < 0.01 * np.abs(moved).max()
    arm = {"bar": np.array([1.0, 1e4, 1e4, 1e4, 1.0, 1.0]), "turn": np.array([0.2, 2.0])}
    options |= {"share": 0.5, "save_dt": 0.1}
    _, found = call("pyelastica", "spin", arm, **options)
    angles = np.arctan2(*found["tips"].T[::-1])
    assert np.allclose(angles[[2, 4]], [0.2, 0.6], atol=5e-3)  # it turns by 2 (t - 0.1)


def test_timing_is_the_median_per_call():
    columns = Timing(2.0, (5.0, 1.0, 3.0)).per(10).columns()
    assert columns == {"compile_s": 2.0, "run_s": 0.3, "run_s_min": 0.1, "run_s_max": 0.5}


def test_plot_is_well_formed():
    text = svg.loglog({"a<b": [(1e-5, 1e-3), (1e-3, 1e-9)], "one": [(1.0, 1.0)]}, "x", "y")
    assert len(list(xml.fromstring(text).iter("{http://www.w3.org/2000/svg}circle"))) == 5


def test_page_names_machine_and_every_row():
    rows = [
        Row("sorojax", {"nodes": 8}, 1.0, 2e-6, 1e-6, 3e-6, 1e-9, "32 nodes", 7e-6),
        Row("other", {"reason": "no <wheel>"}),
    ]
    text = page.html([line("rod.test", item) for item in rows])
    assert "2 us" in text and "no &lt;wheel&gt;" in text and "jax " in text
    assert "http" not in text.replace("http://www.w3.org/2000/svg", "")


def test_suite_names_cases_that_exist_and_groups_all():
    known = discover.cases()
    named = [name for cases in suite.ROWS.values() for name in (*cases.quick, *cases.more)]
    assert set(named) <= known.keys() and len(named) == len(set(named))
    groups = suite.grouped(known)
    assert sorted(n for names in groups.values() for n in names) == sorted(known)
    assert list(groups)[0] == "rod statics" and "fem.cook" in groups["near incompressibility"]
    assert suite.grouped(["my.case", "rod.ik"]) == {
        "inverse kinematics and estimator": ["rod.ik"],
        suite.FURTHER: ["my.case"],
    }


def test_exponents_come_from_the_sizes_and_shortest_runs():
    points = [
        scaling.Point(n, Timing(0.0, (9.0 * n**2, 1.0 * n**2)), 0.5 * n) for n in (10, 100)
    ]
    first, second = scaling.rows("factor", "dof", 1.5, points)
    assert "exponent" not in first.settings and second.settings["exponent"] == 2.0
    assert second.settings["peak_MB"] == 50 and second.run_s_min == 10**4
    text = page.html([line("scaling.test", row) for row in (first, second)])
    assert "<td>2.00</td><td>1.5</td><td>50 MB</td>" in text and "further cases" in text


@pytest.mark.skipif(
    not Path("/proc/self/clear_refs").exists(), reason="peak memory is read from Linux's /proc"
)
def test_peak_is_what_a_call_holds_at_most():
    size = 40 * 2**20
    found = memory.peak(lambda: len(np.ones(size, np.uint8)))
    assert found is not None and 38 < found < 80


def test_page_shows_features_peers_and_bars(monkeypatch, tmp_path):
    monkeypatch.setenv("SOROJAX_PEERS", str(tmp_path))
    pair = [
        Row(
            "sorojax",
            {"feature": "gravity", "scene": scene, "instructions": 9 + k, "flops": 100.0 * k},
            run_s=1e-6 * (1 + k),
        )
        for k, scene in enumerate(("without", "with"))
    ]
    bars = [Row("sorojax", {}, run_s=1.0, bar=2.0), Row("sorojax", {}, run_s=3.0, bar=2.0)]
    lines = [line("skip.features", row) for row in pair]
    text = page.html(lines + [line("rod.statics", row) for row in bars])
    table = "<td>gravity</td><td>9</td><td>10</td><td>0</td><td>100</td>"
    assert table + "<td>1 us</td><td>2 us</td><td>2.00</td>" in text
    assert "<td>1 of 2</td>" in text and "not installed: make peers PEERS=mujoco" in text
    assert text.index('<h2 id="rod-statics">') < text.index(">skip.features</h3>")


def test_a_quick_run_tells_its_cases(monkeypatch):
    monkeypatch.delenv("SOROJAX_BENCH_QUICK", raising=False)
    assert not harness.quick()
    monkeypatch.setenv("SOROJAX_BENCH_QUICK", "1")
    assert harness.quick()


def test_what_a_quick_run_leaves_out_is_on_the_page(folder, monkeypatch):
    """Sizes of a case, and whole cases; nothing in a full run."""
    monkeypatch.delenv("SOROJAX_BENCH_QUICK", raising=False)
    full = run(folder, "math.short")[1]
    assert [x["settings"] for x in full] == [{"size": 1}, {"size": 2}]
    assert "Left out" not in page.html(full) and "quick run" not in page.html(full)
    monkeypatch.setenv("SOROJAX_BENCH_QUICK", "1")
    one, left = run(folder, "math.short")[1]
    assert one["settings"] == {"size": 1} and left["settings"] == {"left_out": ["size <2>"]}
    assert left["holds"] is None and left["run_s"] is None
    text = page.html([one, left], {"math.short": 3.2}, ["math.product"])
    assert "Left out of a quick run: size &lt;2&gt;." in text
    assert "cases left out are math.product" in text and "math.short (3 s)" in text
    assert text.count("<tr><td>sorojax</td>") == 1  # the note is no row of the table
