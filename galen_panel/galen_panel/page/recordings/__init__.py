"""Recordings and reports on the page."""
