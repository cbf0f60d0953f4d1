"""Surfaces of points and heights: triangles, meshes, completion, texture parameters."""
