"""Reference elements with their shape functions and quadrature."""
