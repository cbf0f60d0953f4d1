"""From matches under known rotations to points: translation, triangulation, disparity (the seed's 3.2 and 3.3)."""
