"""A node as a process: lifecycle, diagnostics, spinning, background work."""
