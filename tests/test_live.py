"""A viewer process of a running loop: latest frame wins, nobody waits, nobody stays behind."""

import base64
import json
import os
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import chromium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import rod as R, view
from sorojax.math.lie import SE2
from sorojax.view.live_view import Slots
from sorojax.view.viewer import follow

ROOT = Path(__file__).parent.parent


@pytest.fixture
def slots():
    made = Slots.new(4)
    yield made
    made.path.unlink()


def test_the_latest_frame_wins(slots):
    assert slots.take(0) is None
    for k in range(1, 8):
        slots.put(0.1 * k, np.full(4, float(k)))
    frame = slots.take(0)
    assert (frame.number, frame.time) == (7, 0.1 * 7) and np.all(frame.values == 7.0)
    assert slots.take(7) is None


def test_frames_are_never_torn(slots):
    """A reader that is slower than the writer sees whole frames in rising order."""
    done = threading.Event()

    def write():
        for k in range(1, 30_001):
            slots.put(float(k), np.full(4, float(k)))
        done.set()

    writer = threading.Thread(target=write)
    writer.start()
    other, seen = Slots(slots.path, 4), []
    while not done.is_set() or not seen or seen[-1].number < 30_000:
        if (frame := other.take(seen[-1].number if seen else 0)) is not None:
            seen.append(frame)
    writer.join()
    assert all(np.all(f.values == f.number) and f.time == f.number for f in seen)
    assert np.all(np.diff([f.number for f in seen]) > 0) and seen[-1].number == 30_000


class Slow(view.AbstractSink):
    """Takes its time over every frame."""

    size, fps = 4, 1000.0

    def __init__(self):
        self.seen = []

    def open(self):
        return ""

    def show(self, time, values):
        self.seen.append(values[0])
        threading.Event().wait(0.02)

    def close(self):
        pass


def test_a_slow_viewer_drops_frames_and_keeps_the_last(slots):
    sink, gone = Slow(), threading.Event()
    reader = threading.Thread(target=follow, args=(sink, slots, gone))
    reader.start()
    for k in range(400):
        slots.put(k, np.full(4, float(k)))
        time.sleep(0.0005)
    gone.set()
    reader.join()
    assert len(sink.seen) < 100 and sink.seen[-1] == 399.0


def test_a_viewer_process_records_a_loop(tmp_path):
    file = tmp_path / "seen.npz"
    with view.live(view.Recording(file, 3, fps=200.0)) as feed:
        assert feed.alive and feed.url == ""
        spent = []
        for k in range(300):
            start = time.perf_counter()
            feed.send(0.01 * k, [k, 2 * k, 3 * k])
            spent.append(time.perf_counter() - start)
            time.sleep(0.001)
        with pytest.raises(ValueError, match="got 2 values, need 3"):
            feed.send(0.0, [1.0, 2.0])

        @jax.jit
        def simulated(x):
            jax.debug.callback(feed.send, 10.0, x)
            return 2 * x

        simulated(jnp.ones(3)).block_until_ready()
        jax.effects_barrier()
    assert not feed.alive and feed.sent == 301
    with np.load(file) as seen:
        assert 3 <= len(seen["time"]) <= 301 and np.all(np.diff(seen["time"]) > 0)
        assert seen["time"][-1] == 10.0 and np.all(seen["values"][-1] == 1.0)
        rows = seen["values"][:-1]
        assert np.allclose(rows, seen["time"][:-1, None] * [100.0, 200.0, 300.0])
    assert sorted(spent)[len(spent) // 2] < 1e-3  # a wait for the viewer takes 5 ms
    feed.send(0.0, np.zeros(3))  # a viewer that is gone does no harm


SCRIPT = """
import os, sys
from sorojax import view
feed = view.live(view.Recording(sys.argv[1], 2))
feed.send(1.0, [3.0, 4.0])
print(feed._slots.path, flush=True)
os._exit(1)
"""


def test_a_viewer_ends_when_its_loop_dies(tmp_path):
    file = tmp_path / "seen.npz"
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(file)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    limit = time.monotonic() + 20.0
    slots = Path(done.stdout.strip())
    while slots.exists() and time.monotonic() < limit:
        time.sleep(0.05)
    assert not slots.exists()
    with np.load(file) as seen:
        assert np.array_equal(seen["values"], [[3.0, 4.0]])


def test_a_sink_that_cannot_start_is_named(tmp_path):
    with pytest.raises(RuntimeError, match="before it was ready"):
        view.live(view.Recording(tmp_path / "no" / "folder.npz", 2)).close()


@pytest.fixture(scope="module")
def rig():
    rod = R.rod(
        SE2(),
        R.constant("kappa_z"),
        R.circle(0.005),
        length=0.06,
        young_modulus=1e5,
        poisson_ratio=0.49,
        density=1e3,
    )
    return view.rig(rod, around=6, stations=5)


def test_a_page_follows_the_loop(rig):
    with view.live(rig, title="finger") as feed:
        page = urllib.request.urlopen(feed.url, timeout=20).read().decode()
        meta = json.loads(page.split('id="meta">')[1].split("</script>")[0])
        assert meta["live"] == "frames" and meta["title"] == "finger"
        feed.send(0.5, [20.0])
        with urllib.request.urlopen(f"{feed.url}frames", timeout=20) as stream:
            line = next(line for line in stream if line.startswith(b"data: "))
        news = json.loads(line[6:])
        words = np.frombuffer(base64.b64decode(news["points"]), "<i2").reshape(3, -1).T
        low, high = (np.array(meta["actors"][0][end]) for end in ("low", "high"))
        points = (low + high) / 2 + (high - low) / 2 * words / 32767
        assert news["stamp"] == "t = 0.50 s"
        exact = np.asarray(view.pose(rig, jnp.array([20.0])))
        assert np.all(np.abs(points - exact) <= 0.51 * (high - low) / 65534)
        foreign = urllib.request.Request(feed.url, headers={"Host": "elsewhere.example"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(foreign, timeout=20)
    assert not feed.alive and not os.path.exists(feed._slots.path)


@chromium.needed
def test_a_browser_shows_the_loop(rig):
    with view.live(rig) as feed, chromium.tab() as tab:
        feed.send(0.0, [0.0])
        tab.call("Page.navigate", url=feed.url)
        stamp = "document.getElementById('stamp').textContent"
        tab.wait(f"Boolean(window.viewer && viewer.ready) && {stamp} === 't = 0.00 s'")
        straight = tab.picture()
        feed.send(1.0, [30.0])
        tab.wait(f"{stamp} === 't = 1.00 s'")
        bent = tab.picture()
        assert np.mean(np.any(straight[:540] < 200, axis=2)) > 0.003
        assert np.mean(np.any(np.abs(straight - bent) > 20, axis=2)) > 0.005
        asked = {url for url in tab.requests if not url.endswith("favicon.ico")}
        assert asked == {feed.url, f"{feed.url}frames"}


def test_a_viser_scene_follows_the_loop(rig):
    """The scene in this process; `live` starts it in another like any sink."""
    pytest.importorskip("viser", reason="the extra `live` is not installed")
    sink = view.Viser(rig, port=0)
    address = sink.open()
    try:
        with urllib.request.urlopen(address, timeout=20) as page:
            assert b"<html" in page.read().lower()
        for time_of, q in ((0.0, 0.0), (0.5, 20.0)):
            sink.show(time_of, np.array([q]))
            exact = np.asarray(view.pose(rig, jnp.array([q])))
            shown = sink._mesh.vertices
            assert np.allclose(shown[:, : exact.shape[1]], exact, atol=1e-7)
        assert sink._stamp.value == "t = 0.50 s"
    finally:
        sink.close()
    with pytest.raises(OSError):
        urllib.request.urlopen(address, timeout=5)


def test_viser_missing_is_named(rig, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ModuleNotFoundError, match=r"sorojax\[live\]"):
        view.Viser(rig).open()
