"""Point clouds brought together: iterative closest point, and sequences of clouds."""
