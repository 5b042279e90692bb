"""What can go wrong with a deflection, measured or modelled."""

from galen_model.errors import GalenError


class FitError(GalenError):
    """A model that can't be fitted to the samples given; the message says why."""


class NegativeComplianceError(FitError):
    """Samples that want a spring to push back; the message names the spring."""


class ModelFileError(GalenError):
    """A model's file is missing, unreadable or does not say what it must."""


class PushRecordingError(GalenError):
    """A recording doesn't hold what a deflection is found from; the message says what lacks."""


class RegistrationError(GalenError):
    """The tracker can't be registered to the arm, or the registration doesn't hold."""
