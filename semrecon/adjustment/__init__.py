"""Bundle adjustment of a tilt series: what may be wrong with its cameras, and how far to trust the answer."""
