"""Primitive shapes, in the plane and in space."""
