"""A long untouched recording: drift, and whether it can be predicted."""
