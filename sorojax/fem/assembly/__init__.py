"""Internal forces and tangents: shape functions, energies, element matrices."""
