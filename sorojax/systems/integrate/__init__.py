"""Simulation of blocks and networks."""
