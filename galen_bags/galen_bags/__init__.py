"""Bags in and out: read into arrays, record, play, work through many."""

from galen_model.errors import GalenError


class BagError(GalenError):
    """A bag that can't be read or written; the message names it and gives the reason."""
