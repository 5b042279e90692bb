"""Errors of a deflection, measured or modelled."""

from galen_model.errors import GalenError


class DeflectionError(GalenError):
    """A recording, a model's file or a prediction that is unusable; the message says why."""


class FitError(DeflectionError):
    """A model that can't be fitted to the samples given; the message says why."""


class RegistrationError(DeflectionError):
    """The tracker can't be registered to the arm, or the registration doesn't hold."""


class SplitError(DeflectionError):
    """Samples that can't be split as asked; the message says what lacks."""
