"""Contact with shapes and between bodies."""
