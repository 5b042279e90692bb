"""Effects of the load."""
