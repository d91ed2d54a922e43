"""Names of cells in files. The order of nodes is that of VTK on both sides."""

from sorojax import mesh as M
from sorojax.mesh.elements import AbstractElement, PolyN

_TYPES = {
    "Tri3": "triangle", "Tri6": "triangle6", "Quad4": "quad", "Quad8": "quad8",
    "Quad9": "quad9", "Tet4": "tetra", "Tet10": "tetra10", "Hex8": "hexahedron",
    "Hex20": "hexahedron20",
}  # fmt: skip
_FACETS = {
    "Tri3": "line", "Tri6": "line3", "Quad4": "line", "Quad8": "line3", "Quad9": "line3",
    "Tet4": "triangle", "Tet10": "triangle6", "Hex8": "quad", "Hex20": "quad8",
}  # fmt: skip
_DIMS = {"vertex": 0, "line": 1, "triangle": 2, "quad": 2, "polygon": 2}


def type_of(where: str, element: AbstractElement) -> str:
    if isinstance(element, PolyN):
        return "polygon"
    if element.name not in _TYPES:
        raise ValueError(f"{where}: got {element.name} cells, need one of {', '.join(_TYPES)}.")
    return _TYPES[element.name]


def facet_type_of(element: AbstractElement) -> str:
    return "line" if isinstance(element, PolyN) else _FACETS[element.name]


def kind_of(name: str) -> str:
    """`name` without the number of corners that some readers put behind "polygon"."""
    return "polygon" if name.startswith("polygon") else name


def topological_dim(name: str) -> int:
    stem = name.rstrip("0123456789")
    return _DIMS.get(stem, 3)


def element_of(where: str, name: str, count: int) -> AbstractElement:
    if name == "polygon":
        return PolyN(count)
    for own, foreign in _TYPES.items():
        if foreign == name and hasattr(M, own):
            return getattr(M, own)()
    raise ValueError(
        f"{where}: the file has {name} cells, need one of {', '.join(_TYPES.values())}. Mesh "
        "the part with one of these."
    )
