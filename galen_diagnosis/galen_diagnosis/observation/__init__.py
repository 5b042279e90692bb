"""A recording as whitened rows."""
