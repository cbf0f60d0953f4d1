"""Reconstruct a surface from tilted SEM micrographs, simulated or real. Knows nothing of the simulation."""

__version__ = "0.1.0"
