"""Simulation models of the printable robots."""
