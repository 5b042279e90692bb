"""Live plots and the arm in three dimensions."""
