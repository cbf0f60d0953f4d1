"""Photograph a known mesh the way an SEM would and keep the exact truth. Knows nothing of reconstruction."""

__version__ = "0.1.0"
