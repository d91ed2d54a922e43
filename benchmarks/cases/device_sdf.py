"""Field and normals of a solid on an accelerator, against one CPU core and NumPy."""

import jax.numpy as jnp

from benchmarks import csg, devices
from benchmarks.harness import quick
from sorojax import sdf

ERRORS = {True: 1e-14, False: 1e-6}  # double precision or single


def field(shape, points):
    return sdf.evaluate(shape, points)


def normals(shape, points):
    return sdf.normal(shape, points)


def rows():
    cpu, *others = devices.found()
    if not others:
        yield devices.absent()
        return
    shape, points = csg.solid(), csg.points("float64")
    few = jnp.asarray(points)
    truth = {"field": csg.in_numpy(points), "normals": devices.on_cpu(normals, shape, few)}
    for what, function in (("field", field), ("normals", normals)):
        for double in (True, False):
            for times in (1,) if quick("16 million points") else (1, 16):
                # single precision chooses another side of an edge: no normal is wrong there
                told = what == "field" or double
                yield from devices.compared(
                    what,
                    function,
                    (shape, jnp.tile(few, (times, 1))),
                    count=times * csg.POINTS,
                    of="points",
                    double=double,
                    error_of=devices.relative(truth[what]),
                    bar=ERRORS[double] if told else None,
                    reference="NumPy in double precision" if what == "field" else "CPU",
                    devices=[cpu, *others] if times == 1 else others,
                )
