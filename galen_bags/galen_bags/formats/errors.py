# SPDX-License-Identifier: Apache-2.0
"""What goes wrong with a bag."""

from galen_model.errors import GalenError


class BagError(GalenError):
    """A bag that can't be read or written; the message names it and gives the reason."""
