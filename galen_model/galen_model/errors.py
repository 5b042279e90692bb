"""Errors that the suite raises for bad input; each message names the file, topic or value."""


class GalenError(Exception):
    """Base of every error that a user can cause and mend."""


class ToolNameError(GalenError):
    """A tool's name holds something that must not reach a path."""


class ToolFileError(GalenError):
    """A tool's file is missing, unreadable or does not say what it must."""


class KinematicsError(GalenError):
    """A pose that the arm can't take."""


class IdentificationError(GalenError):
    """A load can't be identified from the readings given."""


class NotExcitedError(IdentificationError):
    """The poses don't tell what was asked; the message names what is missing."""


class NotToldApartError(NotExcitedError):
    """Two parameters that the poses can't tell apart; `pairs` holds their names."""

    def __init__(self, message: str, pairs: tuple[tuple[str, ...], ...]) -> None:
        super().__init__(message)
        self.pairs = pairs


class ImplausibleLoadError(IdentificationError):
    """The readings name a load that can't be, such as a mass that isn't positive."""
