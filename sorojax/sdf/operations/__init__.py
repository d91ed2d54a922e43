"""Shapes from shapes: combined, moved, bent, lifted into space."""
