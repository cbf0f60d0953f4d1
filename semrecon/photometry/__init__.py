"""What brightness says of slopes: several detectors, one secondary-electron image, the sign of a relief."""
