"""Reconstruct a surface from tilted SEM micrographs, simulated or real. Knows nothing of the simulation."""

__version__ = "0.1.0"

DEFAULT_METHOD = "dense_multiview"
"""Method that runs when none is named; kept here, where nothing slow is imported."""
