"""Looking at a robot while it runs."""
