"""Bags and tables as arrays."""
