"""Closed triangle meshes as shapes: the closest triangle, the side, rays."""
