"""Models of the deflection behind one interface."""
