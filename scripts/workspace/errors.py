"""The error that a person sees as one line."""

from __future__ import annotations


class SetupError(Exception):
    """Set-up or build cannot go on; the message says in one line why, and the remedy."""
