"""What a feature costs where it is, and that it costs nothing where it is not."""

import jax

from benchmarks.harness import Row, measure
from benchmarks.scenes import features, operations

LOOPS = 200


def repeated(function):
    """Many evaluations that depend on each other."""

    def run(*args):
        def again(_, carried):
            out = function(*args[:-1], carried)
            small = sum(x.sum() for x in jax.tree.leaves(out)) * 1e-30
            return jax.tree.map(lambda x: x + small, carried)

        return jax.lax.fori_loop(0, LOOPS, again, args[-1])

    return run


def rows():
    for feature in features():
        for state, scene in (("without", feature.without), ("with", feature.with_it)):
            instructions, flops = operations(scene)
            function, args = scene
            timing = measure(repeated(function), *args, repeats=5).per(LOOPS)
            settings = {"feature": feature.name, "scene": state}
            more = {"instructions": instructions, "flops": flops}
            yield Row("sorojax", settings | more, **timing.columns())
