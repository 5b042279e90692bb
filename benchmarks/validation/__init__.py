"""Long scores of the suite's own statements."""
