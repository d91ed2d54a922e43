"""Parameters from experiments."""
