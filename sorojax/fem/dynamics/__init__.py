"""Motion: time integration on the host and under `jit`, and its derivative."""
