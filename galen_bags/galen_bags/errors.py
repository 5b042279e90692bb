"""What can go wrong with a bag."""

from galen_model.errors import GalenError


class BagError(GalenError):
    """A bag that can't be read or written; the message names it and says why."""


class ClusterError(GalenError):
    """Processes or a scheduler for many bags that can't be used; the message says why."""
