"""Progress: what a terminal, a notebook and a callback see, and that long calls tell."""

import io
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import SE2, _progress, fem, listen, material, mesh, rod, sdf, silent, systems
from sorojax._progress import Notebook, Progress, Terminal, Watch, report


class Clock:
    """A time that a test sets."""

    now = 100.0

    def __call__(self):
        return self.now


def test_a_terminal_shows_time_left_and_numbers():
    clock, stream = Clock(), io.StringIO()
    bar = Terminal(stream, Watch(clock))
    for k in (1, 2, 3, 4):
        clock.now += 5.0
        bar(Progress("path", k, 4, {"residual": 1.25e-3}))
    lines = stream.getvalue().split("\r\x1b[K")[1:]
    assert lines[0].endswith("? left") and "10 s left" not in lines[0]
    assert lines[1] == "path:  50 %  residual 0.00125  5 s left"
    assert lines[2] == "path:  75 %  residual 0.00125  3 s left"
    assert lines[3] == "path: 100 %  residual 0.00125  15 s, done\n"


def test_quick_calls_leave_no_line_and_fast_reports_are_dropped():
    clock, stream = Clock(), io.StringIO()
    bar = Terminal(stream, Watch(clock))
    for k in range(1, 1001):
        clock.now += 0.0005
        bar(Progress("quick", k, 1000))
    assert "\n" not in stream.getvalue()
    assert stream.getvalue().count("quick") < 10  # ten a second
    assert stream.getvalue().endswith("\r\x1b[K")


def test_calls_inside_calls_keep_their_own_time():
    clock, seen = Clock(), []
    watch = Watch(clock)
    for outer in (1, 2, 3, 4):
        for inner in (1, 2):
            clock.now += 10.0
            seen.append(watch.look(Progress("inner", inner, 2)))
        seen.append(watch.look(Progress("outer", outer, 4)))
    texts = [view.text for view in seen if view is not None]
    assert [t for t in texts if t.startswith("inner: 100")] == ["inner: 100 %  10 s, done"] * 4
    assert texts[5] == "outer:  50 %  20 s left" and texts[-1] == "outer: 100 %  60 s, done"


def test_a_call_made_again_starts_anew():
    clock = Clock()
    watch = Watch(clock)
    watch.look(Progress("path", 9, 10))
    clock.now += 1000.0
    watch.look(Progress("path", 1, 10))
    clock.now += 1.0
    view = watch.look(Progress("path", 2, 10))
    assert view is not None and view.text == "path:  20 %  4 s left"


def test_a_notebook_has_a_bar_per_call():
    shown, clock = [], Clock()

    class Handle:
        def __init__(self, picture):
            self.pictures = [picture]
            shown.append(self)

        def update(self, picture, raw):
            assert raw
            self.pictures.append(picture)

    bar = Notebook(lambda picture, raw, display_id: Handle(picture), Watch(clock))
    for label in ("a", "<b>"):
        for k in (1, 2):
            clock.now += 1.0
            bar(Progress(label, k, 2))
    assert [len(handle.pictures) for handle in shown] == [2, 2]
    assert 'value="0.5000"' in shown[0].pictures[0]["text/html"]
    assert "&lt;b&gt;" in shown[1].pictures[1]["text/html"]
    assert shown[1].pictures[1]["text/plain"].startswith("<b>: 100 %")


@pytest.mark.parametrize(
    ("seconds", "text"), [(5.2, "5 s"), (89, "89 s"), (125, "2 min 05 s"), (7200, "2.0 h")]
)
def test_times_are_said_as_people_do(seconds, text):
    assert _progress._span(seconds) == text


def test_nothing_is_told_without_a_listener():
    with silent():
        start = time.perf_counter()
        for k in range(20_000):
            report("loop", k, 20_000, residual=0.1)
        spent = time.perf_counter() - start
    with listen(lambda progress: None):
        start = time.perf_counter()
        for k in range(20_000):
            report("loop", k, 20_000, residual=0.1)
        assert spent < time.perf_counter() - start


def test_a_callback_may_end_a_call():
    class Enough(Exception):
        pass

    def stop(progress):
        if progress.fraction > 0.5:
            raise Enough

    with pytest.raises(Enough), listen(stop):
        mesh.polymesher(sdf.Circle([0.0, 0.0], 1.0), 20, key=jax.random.key(0), iterations=20)
    with listen(stop), silent():
        report("loop", 1, 1)


SCRIPT = """
import sys, types
from sorojax import _progress
shell = types.ModuleType("IPython")
shell.get_ipython = lambda: types.SimpleNamespace(kernel=1)
show = types.ModuleType("IPython.display")
show.display = lambda picture, raw, display_id: print(picture["text/plain"])
if len(sys.argv) > 1:
    sys.modules |= {"IPython": shell, "IPython.display": show}
_progress.report("call", 1, 1)
"""


@pytest.mark.parametrize(("arguments", "said"), [([], ""), (["notebook"], "call: 100 %")])
def test_the_default_knows_where_it_runs(arguments, said):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *arguments], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith(said) and bool(done.stdout) == bool(said)
    assert done.stderr == ""


def test_meshing_tells_how_far_it_is():
    told = []
    with listen(told.append):
        mesh.tetrahedralise(sdf.Box([0.0, 0.0, 0.0], [1.0, 0.7, 0.5]), size=0.3)
    mine = [p for p in told if p.label == "tetrahedralise"]
    assert len(mine) > 2 and "moved" in mine[0].numbers
    steps = np.diff([p.done for p in mine])
    ended = np.array([p.fraction == 1.0 for p in mine])
    assert np.all((steps == 1) | (steps < 0) | ended[1:])  # a second series starts anew
    assert ended[-1]


def test_a_long_search_for_an_equilibrium_tells_its_iterations(monkeypatch):
    square = mesh.rectangle([0, 0], [1.0, 1.0], divisions=(2, 2), element=mesh.Quad9())
    rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1e3)
    problem = fem.problem(
        square,
        rubber,
        kinematics=fem.PlaneStrain(1.0),
        supports=(fem.Fixed(square.node_sets["left"]),),
        loads=(fem.Force(square.node_sets["right"], [0.0, -1e3]),),
    )
    for worth, count in ((60.0, 0), (0.0, 2)):
        told = []
        monkeypatch.setattr(_progress, "_WORTH", worth)
        with listen(told.append):
            fem.solve(problem)
        mine = [p for p in told if p.label == "newton"]
        assert len(mine) >= count and bool(mine) == bool(count)
    assert mine[-1].fraction == 1.0 and mine[0].numbers["imbalance"] > 0


FINGER = rod.rod(
    SE2(),
    rod.chebyshev(kappa_z=1),
    rod.circle(0.01),
    length=0.1,
    young_modulus=1e5,
    poisson_ratio=0.4,
    density=1e3,
    nodes=4,
)


def swing(q, progress):
    return rod.rollout(FINGER, q, jnp.zeros(1), step=1e-3, saves=250, progress=progress).q


@pytest.mark.parametrize("lanes", [0, 3])
def test_a_rollout_tells_about_a_hundred_times_also_of_many_rods(lanes):
    told, start = [], jnp.full((lanes, 1) if lanes else 1, 2.0)
    go = jax.vmap(swing, (0, None)) if lanes else swing
    with listen(told.append):
        loud = jax.block_until_ready(go(start, True))
        jax.effects_barrier()
    quiet = go(start, False)
    assert jnp.array_equal(loud, quiet)
    assert {p.label for p in told} == {"rollout"} and told[-1].fraction == 1.0
    shares = [p.fraction for p in told]
    assert shares == sorted(shares) and 100 <= len(shares) <= 130


def weighed(factor):
    return (rod.Gravity(factor * jnp.array([0.0, -9.81])),)


def test_paths_of_a_rod_tell_every_state():
    told = []
    with listen(told.append):
        path = rod.equilibrium_path(FINGER, weighed, jnp.linspace(0, 1, 5), progress=True)
        arc = rod.arc_length_path(FINGER, weighed, steps=4, progress=True)
        jax.block_until_ready((path.q, arc.q))
        jax.effects_barrier()
    for label, count in (("equilibrium path", 5), ("arc length path", 4)):
        shares = [p.fraction for p in told if p.label == label]
        assert np.allclose(shares, np.arange(1, count + 1) / count)
    quiet = rod.equilibrium_path(FINGER, weighed, jnp.linspace(0, 1, 5))
    assert jnp.array_equal(path.q, quiet.q)


def lag_to_one(pace):
    return systems.Network({"lag": systems.Lag(pace)}, {}, ("lag.a",))


def batch(paces, progress):
    return systems.simulate_batch(
        lag_to_one,
        paces,
        1.0,
        inputs={"lag.a": 1.0},
        save=3,
        cheap_steps=100,
        progress=progress,
    )


def test_a_batch_tells_its_mean_and_who_ran_again():
    told, paces = [], jnp.array([0.1, 0.2, 1e-5, 0.3])  # the third is stiff
    with listen(told.append):
        loud = jax.block_until_ready(batch(paces, True))
        jax.effects_barrier()
    assert loud.stats["stiff"].tolist() == [False, False, True, False]
    first = [p.fraction for p in told if p.label == "batch"]
    assert len(first) > 3 and first == sorted(first) and first[-1] > 0.7
    again = [p.fraction for p in told if p.label == "stiff members"]
    assert again == [0.75, 1.0]
    quiet = batch(paces, False)
    assert jnp.array_equal(loud["lag.value"], quiet["lag.value"])


@pytest.mark.parametrize(
    "call", [lambda p: swing(jnp.ones(1), p), lambda p: batch(jnp.array([0.1, 0.2]), p)]
)
def test_a_compiled_run_without_progress_has_no_callback(call):
    silent_one, loud = (str(jax.make_jaxpr(lambda p=p: call(p))()) for p in (False, True))
    assert "debug_callback" not in silent_one and "debug_callback" in loud


def test_surfaces_tell_how_far_they_are():
    told = []
    with listen(told.append):
        sdf.isosurface(sdf.Sphere([0.0, 0.0, 0.0], 1.0), 0.009)
    mine = [p for p in told if p.label == "isosurface"]
    assert mine[-1].fraction == 1.0 and len(mine) >= 2
