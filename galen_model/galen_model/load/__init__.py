"""What a load reads at the wrist, and its identification."""
