"""A sensor's bias over a sweep: constant, straight or drifting."""
