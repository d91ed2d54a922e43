"""Optimisation loops and methods."""
