"""Plane meshes: outlines, triangles, polygons."""
