"""The corrections that are subtracted from a wrench."""
