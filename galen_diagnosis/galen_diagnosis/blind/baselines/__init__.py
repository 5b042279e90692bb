"""Simpler methods beside the diagnosis."""
