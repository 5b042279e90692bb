# SPDX-License-Identifier: Apache-2.0
"""Errors that the suite raises for bad input; each message names the file, topic or value."""

LONGEST_MESSAGE = 1000
"""Letters of an error's message; more of a hostile file must not get into a terminal or a log."""


class GalenError(Exception):
    """Base of every error that a user can cause and fix; its message is one line."""

    def __str__(self) -> str:
        return one_line(super().__str__())


def one_line(text: str, longest: int = LONGEST_MESSAGE) -> str:
    """Make a text that is not trusted one line that can be printed and sent.

    Topics and cells of tables may be of any length and hold anything: ends of lines, what moves a
    terminal's cursor, halves of surrogate pairs, which neither a terminal nor a message takes.

    Args:
        text: any text.
        longest: most characters of the result.

    Returns:
        The text with its unprintable characters escaped, cut with " ..." where it is longer.

    """
    shown = text[: longest + 1]
    if not shown.isprintable():
        shown = "".join(c if c.isprintable() else repr(c)[1:-1] for c in shown)
    return shown if len(shown) <= longest else shown[: longest - 4] + " ..."


class ToolNameError(GalenError):
    """A tool's name holds something that must not reach a path."""


class CalibrationFileError(GalenError):
    """A calibration file is missing, unreadable or does not say what it must."""


class KinematicsError(GalenError):
    """A pose that the arm can't take."""


class IdentificationError(GalenError):
    """A load can't be identified from the readings given."""


class NotExcitedError(IdentificationError):
    """The poses don't identify what was asked; the message names what is missing."""
