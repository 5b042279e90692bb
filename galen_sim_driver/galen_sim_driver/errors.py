"""What the simulated driver rejects."""

from galen_model.errors import GalenError


class ConfigError(GalenError):
    """A configuration value can't be used; the message names it."""


class TrajectoryError(GalenError):
    """A trajectory is rejected as a whole; the message names the joint and the value."""


class UnknownToolError(GalenError):
    """No tool of this name is configured."""


class ZeroingError(GalenError):
    """The sensor can't be zeroed now, or the zeroing was spoilt."""


class HandBusyError(GalenError):
    """The hand pushes already."""
