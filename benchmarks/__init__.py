"""Timings with errors: `python -m benchmarks --help`. See README.md here."""
