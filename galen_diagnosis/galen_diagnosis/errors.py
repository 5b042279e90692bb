"""What goes wrong in a diagnosis."""

from galen_model.errors import GalenError


class DiagnosisError(GalenError):
    """A recording can't be diagnosed; the sentence names what and why."""
