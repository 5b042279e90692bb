"""Collecting pushes on the arm."""
