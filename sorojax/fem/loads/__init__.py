"""Loads as potentials."""
