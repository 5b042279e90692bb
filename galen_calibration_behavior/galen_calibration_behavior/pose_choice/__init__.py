"""Poses chosen for information."""
