"""Predicts how far the arm bends under load, live and on recordings."""
