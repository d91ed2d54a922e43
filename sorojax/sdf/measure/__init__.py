"""Areas, volumes and moments of shapes."""
