"""Equilibria, load paths and inverse kinematics."""
