"""Several bodies as one mesh."""

import jax.numpy as jnp
import numpy as np

from sorojax.mesh.mesh import Mesh


def joined(**bodies: Mesh) -> Mesh:
    """One mesh of several bodies that share no nodes, for contact between them.

    `joined(finger=a, ball=b)` names the cells of each body in `regions`, its nodes in
    `node_sets`, and its sets "finger.top"; nodes keep their order, body after body.
    Differentiable in the points.

    Raises:
        ValueError: If there is no body, or the elements differ.
    """
    kinds = {type(body.element).__name__ for body in bodies.values()}
    if len(kinds) != 1:
        raise ValueError(
            f"mesh.joined: got bodies of {sorted(kinds)}, need one kind of cells for all. "
            "Mesh them alike."
        )
    nodes, cells, node_sets, facet_sets, regions = 0, [], {}, {}, {}
    num_cells = 0
    for name, body in bodies.items():
        cells.append(np.asarray(body.cells) + nodes)
        node_sets[name] = np.arange(nodes, nodes + body.num_nodes)
        regions[name] = np.arange(num_cells, num_cells + body.num_cells)
        node_sets |= {f"{name}.{key}": ids + nodes for key, ids in body.node_sets.items()}
        facet_sets |= {f"{name}.{key}": ids + nodes for key, ids in body.facet_sets.items()}
        regions |= {f"{name}.{key}": ids + num_cells for key, ids in body.regions.items()}
        nodes, num_cells = nodes + body.num_nodes, num_cells + body.num_cells
    points = jnp.concatenate([body.points for body in bodies.values()])
    element = next(iter(bodies.values())).element
    return Mesh(points, np.concatenate(cells), element, node_sets, facet_sets, regions)
