"""What a feature costs where it is, and that it costs nothing where it is not."""

import jax

from benchmarks.harness import Row, measure_together, quick
from benchmarks.scenes import Feature, features, operations

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


#: Enough to see that what is absent costs nothing.
FEW = ("gravity", "contact", "third dimension", "follower load")


def together(feature: Feature):
    """Times of both scenes, in turn."""
    (bare, args), (full, more) = feature.without, feature.with_it
    runs = {
        "without": lambda args, more: repeated(bare)(*args),
        "with": lambda args, more: repeated(full)(*more),
    }
    return measure_together(runs, args, more, repeats=5)


def rows():
    for feature in features():
        if feature.name not in FEW and quick(feature.name):
            continue
        times = together(feature)
        for state, scene in (("without", feature.without), ("with", feature.with_it)):
            instructions, flops = operations(scene)
            settings = {"feature": feature.name, "scene": state}
            more = {"instructions": instructions, "flops": flops}
            yield Row("sorojax", settings | more, **times[state].per(LOOPS).columns())
