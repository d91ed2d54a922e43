"""The stages of the main job, reported as they happen, and its results on disk."""

import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from sorojax.cli.demo import design as designs
from sorojax.cli.demo.results import Results, numbers, pictures, write
from sorojax.units import kPa, mm


def run(out: Path, quick: bool = False) -> int:
    """Run the job and put its results in `out`, all of them or none.

    Args:
        out: Folder of the results; what an earlier run left there is replaced.
        quick: Coarse mesh, few load steps and 2 s of closed loop instead of 3.

    Raises:
        ValueError: If `out` is something else than a folder of results.
    """
    _check_out(out)
    clock = _Clock()
    size, steps, duration = (1.2 * mm, 9, 2.0) if quick else (0.7 * mm, 11, 3.0)
    print("sorojax demo: a bellows actuator from its drawing to a closed loop", flush=True)
    with clock.stage("rubber, drawing and mesh") as tell:
        design = designs.draw(size)
        tell(
            f"{design.problem.mesh.num_cells} triangles, area off by "
            f"{abs(design.meshed_area / design.area - 1):.1e}"
        )
    with clock.stage("equilibria, strain modes, rod and closed loop") as tell:
        job = designs.Job(design, jnp.linspace(0.0, designs.TOP_PRESSURE, steps), duration)
        first = job.run(job.numbers)
        tracking = designs.tracking(first)
        tell(
            f"0 to {designs.TOP_PRESSURE / kPa:g} kPa in {steps} states, {duration:g} s of "
            f"loop in {tracking.steps} steps, rms {np.degrees(tracking.rms):.2f} deg"
        )
    with clock.stage("gradients by dimensions and gains, and a difference") as tell:
        slopes = designs.sensitivities(job, first)
        off = max(slope.error for slope in slopes.values())
        tell(f"2 gradients by {len(job.numbers)} numbers, central difference off by {off:.1e}")
    with clock.stage("rod beside the solid") as tell:
        beside = designs.bent(first)
        tell(f"3 bending modes, backbone within {beside.errors.max() / mm:.3f} mm")
    results = Results(design, first, slopes, tracking, beside)
    with clock.stage("pictures and report") as tell, _all_or_nothing(out) as folder:
        drawn = pictures(results)
        write(folder, drawn, numbers(results), clock.seconds)
        tell(f"{out / 'report.html'}")
    print(f"done in {clock.total:.1f} s: open {out / 'report.html'}", flush=True)
    return 0


class _Clock:
    """Names the stages while they run and keeps their times [s]."""

    count = 5

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.start = time.perf_counter()

    @property
    def total(self) -> float:
        return time.perf_counter() - self.start

    @contextmanager
    def stage(self, name: str) -> Iterator:
        start, said = time.perf_counter(), []
        number = len(self.seconds) + 1
        print(f"[{number}/{self.count}] {name} ...", flush=True)
        yield said.append
        self.seconds[name] = time.perf_counter() - start
        print(f"      {self.seconds[name]:5.1f} s  {' '.join(said)}", flush=True)


_MARK = "result.json"


def _check_out(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise ValueError(f"demo: `--out` is the file {out}, need a folder. Name another.")
    if out.is_dir() and any(out.iterdir()) and not (out / _MARK).is_file():
        raise ValueError(
            f"demo: `--out` {out} holds other files than results, which would be replaced. "
            "Name a new folder."
        )
    out.absolute().parent.mkdir(parents=True, exist_ok=True)


@contextmanager
def _all_or_nothing(out: Path) -> Iterator[Path]:
    """A folder beside `out` that takes its place when everything is written."""
    parent = out.absolute().parent
    with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=parent) as scratch:
        folder = Path(scratch) / "new"
        folder.mkdir()
        yield folder
        if out.exists():
            out.rename(Path(scratch) / "old")
        shutil.move(folder, out)
