"""Where views stand: the tilt axis, all views from their images, later views of any orientation."""
