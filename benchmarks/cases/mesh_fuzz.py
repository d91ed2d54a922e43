"""Random bodies and imported parts: meshes made, refusals with a reason, and the others."""

import collections
import tracemalloc
from time import process_time

import numpy as np

from benchmarks import bodies, parts
from benchmarks.harness import Row, missing, quick
from sorojax import mesh, sdf

#: Kinds of trees, bodies of each, range of `size` [m], share that may be refused, by dimension.
SCENES = {2: (100, 20, (0.05, 0.2), 0.01), 3: (60, 5, (0.1, 0.25), 0.05)}
PART_BAR = 20.0  # s for a part at half of its thinnest wall
LISTED = 2000  # triangles of a part above which what is near is listed beforehand
MOST_CELLS = 200_000
MOST_MEMORY = 10  # of that of the mesh
LEAST_MEMORY = 32 * 2**20  # that any mesh may take: samples of the field come in blocks


def rows():
    for dim, (kinds, each, sizes, most) in SCENES.items():
        kinds = kinds // 10 if quick("most of the random bodies") else kinds
        start = process_time()
        count = _random(dim, kinds, each, sizes)
        ordinary = sum(n for (name, thick), n in count.items() if thick)
        refused = count["refused", True] / max(ordinary, 1)
        wrong = sum(n for (name, _), n in count.items() if name not in ("mesh", "refused"))
        settings = {"case": f"random bodies in {dim} dimensions", "ordinary": ordinary}
        settings |= {
            f"{name}, {'ordinary' if t else 'thin'}": n for (name, t), n in count.items()
        }
        run = (process_time() - start) / sum(count.values())
        yield Row(
            "sorojax",
            settings,
            0.0,
            run,
            run,
            run,
            error=refused,
            bar=most,
            bar_on="error",
            reference="share of ordinary bodies that are refused",
        )
        yield Row(
            "sorojax",
            settings,
            0.0,
            run,
            run,
            run,
            error=float(wrong),
            bar=0.0,
            bar_on="error",
            reference="exceptions, errors without thickness, too much memory",
        )

    yield from _parts()


def _parts():
    """Each part once to compile, once to be timed, at a size of half its thinnest wall."""
    try:
        made = parts.parts()
    except ImportError as reason:
        yield missing("sorojax", f"parts need trimesh and manifold3d: {reason}")
        return
    names = [*made][:4] if quick("most of the parts") else [*made]
    for name in names:
        body, wall = made[name]
        # twelve tetrahedra in a cube of the lattice
        size = max(wall / 2, (12 * body.volume / MOST_CELLS) ** (1 / 3))
        shape = sdf.TriangleMesh(body.vertices, body.faces, lists=len(body.faces) > LISTED)
        settings = {"case": name, "triangles": len(body.faces), "size": round(size, 3)}
        runs = []
        try:
            for _ in range(2):
                start = process_time()
                quality = mesh.quality(mesh.tetrahedralise(shape, size=size))
                runs.append(process_time() - start)
        except ValueError as error:
            yield missing("sorojax", str(error), **settings)
            continue
        angle = round(float(np.rad2deg(quality.min_angle)), 1)
        settings |= {"tetrahedra": quality.num_cells, "dihedral_deg": angle}
        yield Row(
            "sorojax",
            settings,
            runs[0] - runs[1],
            *(3 * [runs[1]]),
            error=abs(quality.area / body.volume - 1),
            reference="the volume",
            bar=PART_BAR,
        )


def _random(dim: int, kinds: int, each: int, sizes) -> collections.Counter:
    """How many bodies ended how, ordinary ones (walls and gaps at least half of `size`) and
    others."""
    count = collections.Counter()
    for number in range(kinds):
        tree = bodies.kind(np.random.default_rng([dim, number]), dim, 3)
        for k in range(each):
            dice = np.random.default_rng([dim, number, k])
            size = float(np.exp(dice.uniform(*np.log(sizes))))
            least = size / 20 if dice.random() < 0.5 else 1.5 * size
            shape = bodies.body(dice, tree, dim, least)
            thickness = bodies.thinnest(shape, size)
            if np.isfinite(thickness) or thickness > 0:
                count[attempt(shape, size), thickness >= size / 2] += 1
    return count


def attempt(shape, size: float) -> str:
    """`"mesh"`, `"refused"`, or what went wrong."""
    make = mesh.triangulate if shape.dim == 2 else mesh.tetrahedralise
    tracemalloc.start()
    try:
        made = make(shape, size=size)
    except ValueError as error:
        return "refused" if " m thick" in str(error) else "error without thickness"
    except Exception as error:  # whatever escapes is what is counted
        return type(error).__name__
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    own = made.points.nbytes + made.cells.nbytes
    return "mesh" if peak < max(MOST_MEMORY * own, LEAST_MEMORY) else "too much memory"
