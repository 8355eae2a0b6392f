"""The one exception that the command line prints as a plain sentence."""

from typing import NoReturn


class UserError(Exception):
    """Something that the person at the keyboard can mend: the message says what is wrong, where, and what to do."""


def refuse(message: str) -> NoReturn:
    """What functions do with a problem unless they are told to gather problems instead."""
    raise UserError(message)
