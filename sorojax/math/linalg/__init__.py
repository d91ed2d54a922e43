"""Linear systems: dense, banded, sparse, multigrid."""
