"""The command `sorojax`."""
