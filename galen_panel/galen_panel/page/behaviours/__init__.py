"""The behaviours: start, follow, outcome."""
