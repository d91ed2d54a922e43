"""Node positions as a differentiable function of the shape."""
