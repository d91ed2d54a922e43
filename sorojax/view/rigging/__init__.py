"""Surfaces carried by rods and links."""
