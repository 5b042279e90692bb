"""The forms in which effects are tried on a recording."""
