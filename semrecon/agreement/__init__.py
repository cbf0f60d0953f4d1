"""Two surfaces of one specimen against each other, also those of other software."""
