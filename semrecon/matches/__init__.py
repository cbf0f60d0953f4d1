"""What two or more views see alike: features, matches under known and unknown geometry, tracks, dense matches."""
