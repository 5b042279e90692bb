"""The gap monitor of a running arm."""
