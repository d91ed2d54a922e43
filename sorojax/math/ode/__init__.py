"""Time integration: explicit, linearly implicit, generalised-alpha, and the size of steps."""
