"""Parameters of nodes as fields of a frozen dataclass."""
