"""Contact with shapes, rods, links and itself."""
