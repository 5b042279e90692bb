"""Predict how far the arm deflects under load, live and on recordings."""
