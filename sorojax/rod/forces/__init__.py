"""Generalised forces."""
