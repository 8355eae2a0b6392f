"""The one exception that the command line prints as a plain sentence."""


class UserError(Exception):
    """Something that the person at the keyboard can mend: the message says what is wrong, where, and what to do."""
