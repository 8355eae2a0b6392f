"""Who may use the viewer: a request that names its address, comes from its own page and knows its token.

The token is part of the page's path. A page takes the address of its WebSocket from its own, so both carry it, also in a
sub-path of a proxy. There is no cookie: a browser would send it to every other port of this machine.
"""

from __future__ import annotations

import hmac
import re
import urllib.parse
from collections.abc import Sequence
from dataclasses import dataclass
from http import HTTPStatus
from typing import NamedTuple, Protocol

LOCAL = ("127.0.0.1", "localhost", "::1")
_HOST = re.compile(r"(?:\[([0-9a-f:.]+)\]|([a-z0-9._-]+))(?::[0-9]{1,5})?")


class Headers(Protocol):
    def get_all(self, key: str) -> Sequence[str]: ...


class Refusal(NamedTuple):
    """The answer to a request that is not let in; `location` leads to where it would be."""

    status: HTTPStatus
    sentence: str
    location: str | None = None


@dataclass(frozen=True)
class AccessCheck:
    token: str
    is_local: bool  # the viewer listens on this machine alone
    url: str | None = None  # where a proxy shows the viewer: http or https, host, path

    def refusal(self, path: str, headers: Headers) -> Refusal | None:
        """None lets the request in. `path` has its query."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        host = hosts[0].lower() if len(hosts) == 1 else ""
        name = _HOST.fullmatch(host)
        if name is None or len(origins) > 1:
            return Refusal(HTTPStatus.BAD_REQUEST, "A browser sends one Host and at most one Origin.")
        parts = urllib.parse.urlsplit((self.url or "").lower())
        if self.is_local and (name[1] or name[2]) not in LOCAL and host != parts.netloc:
            return Refusal(
                HTTPStatus.FORBIDDEN,
                "Open the viewer under the address that it printed. Behind a proxy, start it with --url ADDRESS.",
            )
        if origins and origins[0].lower() not in (
            f"http://{host}",
            f"https://{host}",
            f"{parts.scheme}://{parts.netloc}",
        ):
            return Refusal(
                HTTPStatus.FORBIDDEN,
                "Another site's page may not use the viewer. Behind a proxy, start it with --url ADDRESS.",
            )
        path, _, query = path.partition("?")
        if equal_tokens(path.rstrip("/").rpartition("/")[2], self.token):
            return None
        if equal_tokens(urllib.parse.parse_qs(query).get("token", [""])[0], self.token):
            return Refusal(HTTPStatus.SEE_OTHER, "", f"./{self.token}/")  # relative: it stays in a proxy's sub-path
        return Refusal(HTTPStatus.UNAUTHORIZED, "The viewer needs its token: open the whole address that it printed.")


def equal_tokens(given: str, token: str) -> bool:
    """In a time that tells nothing of how much agrees."""
    return hmac.compare_digest(given.encode("utf-8", "surrogatepass"), token.encode())
