"""Which effects explain the rows, and how probable each is."""
