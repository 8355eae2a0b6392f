"""The one exception that the command line prints as a plain sentence."""

from importlib.util import find_spec
from typing import NoReturn


class UserError(Exception):
    """Something that the person at the keyboard can mend: the message says what is wrong, where, and what to do."""


class MissingPackage(UserError):
    """A package of one of the extras is not installed."""


def install(extra: str) -> str:
    """How to get an extra; the program is on no package index."""
    return f"pip install '.[{extra}]' in the program's checkout"


def check_installed(what: str, extra: str, *packages: str) -> None:
    """Raise MissingPackage where one of an extra's packages is not installed; `what` needs them."""
    if missing := [name for name in packages if find_spec(name) is None]:
        raise MissingPackage(f"{what} needs {' and '.join(missing)}: {install(extra)}")


def refuse(message: str) -> NoReturn:
    """What functions do with a problem by default; others gather problems."""
    raise UserError(message)
