"""Dense heights from all views at once, one stage a file: images, geometry, sweep, aggregation, parallax, confidence.

Inside this package lengths are pixels of the level at hand and heights count up, along the beam of the reference view.
"""
