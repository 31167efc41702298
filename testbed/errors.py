"""The one exception that a user may see: a message, never a traceback."""

from __future__ import annotations


class UserError(Exception):
    """A mistake in what the user gave: the message names the file, the key or the address, and what to do.

    The command line prints it and ends with exit code 2.
    """
