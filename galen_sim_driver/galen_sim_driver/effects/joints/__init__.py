"""Effects of joints and of the base."""
