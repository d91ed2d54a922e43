"""Solid meshes: tetrahedra on a lattice, their edges, interfaces and quality."""
