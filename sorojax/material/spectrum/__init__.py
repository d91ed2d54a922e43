"""Relaxation spectra from tests."""
