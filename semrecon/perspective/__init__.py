"""Micrographs taken for photographs: pinhole cameras, essential matrices, incremental structure from motion."""
