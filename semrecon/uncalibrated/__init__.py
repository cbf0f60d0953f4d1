"""Cameras and points from images alone, under parallel projection: factorization, metric upgrade, stereo."""
