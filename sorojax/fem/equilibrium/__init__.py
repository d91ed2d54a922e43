"""Static equilibrium: Newton's method on the host and under `jit`, and its derivative."""
