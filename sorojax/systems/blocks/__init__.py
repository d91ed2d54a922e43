"""Blocks: rods, bodies, fluidics, signals."""
