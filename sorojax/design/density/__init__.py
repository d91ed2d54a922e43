"""Layouts of densities: filters, stiffness, void, pressure."""
