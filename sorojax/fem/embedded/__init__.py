"""Rods inside a solid whose mesh does not follow them."""
