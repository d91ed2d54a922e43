"""The chamber of a bending actuator found in 100 steps, as in the Sorotoki paper VI-B."""

import time

import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row
from sorojax import design
from sorojax._progress import silent
from sorojax.design.pneunet import sharpness

STEPS = 100
MOST = 60.0  # s in all on one core, compilation too
ACTIVE, GREY = 1e-3, 0.05


def rows():
    for chamber in ("darcy", "flood"):
        start = time.perf_counter()
        cell = design.pneunet_cell(chamber=chamber)
        ticks = [time.perf_counter()]
        with silent():
            found = design.optimise_pneunet(
                cell, steps=STEPS, on_step=lambda _, t=ticks: t.append(time.perf_counter())
            )
        seconds = np.diff(ticks)
        density = cell.plan(found.design, sharpness(STEPS - 1, STEPS))
        objective = found.history["objective"]
        settings = {
            "chamber": chamber, "cells": cell.problem.mesh.num_cells, "steps": len(seconds),
            "output_mm": -1e3 * float(found.objective),
            "output_at_start_mm": -1e3 * float(objective[0]),
            "steps_that_rise": int(np.sum(np.diff(objective) > 0)),
            "whole_s": round(ticks[-1] - start, 1),
        }  # fmt: skip
        yield Row(
            "sorojax",
            settings,
            seconds[0],
            float(np.median(seconds[3:])),
            float(seconds.min()),
            float(seconds[3:].max()),
            error=ticks[-1] - start,
            bar=MOST,
            bar_on="error",
            reference="seconds in all",
        )
        slack = abs(float(jnp.max(found.constraints)))
        yield Row(
            "sorojax",
            settings | {"what": "volume constraint"},
            error=slack,
            bar=ACTIVE,
            bar_on="error",
            reference="active",
        )
        grey = float(design.greyness(density))
        yield Row(
            "sorojax",
            settings | {"what": "grey measure"},
            error=grey,
            bar=GREY,
            bar_on="error",
            reference="black and white",
        )
