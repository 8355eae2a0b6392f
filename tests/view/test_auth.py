"""Which requests may use the viewer."""

from __future__ import annotations

import pytest

pytest.importorskip("websockets")
from websockets.datastructures import Headers

from avatar.view.auth import AccessCheck

TOKEN = "a-token-that-is-long"
HERE = AccessCheck(TOKEN, True)
EVERYWHERE = AccessCheck(TOKEN, False)


def asked(access: AccessCheck, path: str = f"/{TOKEN}/", *more: tuple[str, str], host: str = "127.0.0.1:8080") -> int:
    """The status of the answer; 200 where the request is let in."""
    headers = Headers([("Host", host), *more])
    refusal = access.refusal(path, headers)
    return 200 if refusal is None else refusal.status


def origin(value: str) -> tuple[str, str]:
    return "Origin", value


@pytest.mark.parametrize("access", [HERE, EVERYWHERE])
def test_everybody_needs_the_token(access: AccessCheck) -> None:
    assert asked(access) == asked(access, f"/{TOKEN}") == 200
    for path in ("/", "", "/another/", f"/{TOKEN}x/", f"/{TOKEN}/x", "/?token=another", "/?token=", f"/?Token={TOKEN}"):
        assert asked(access, path) == 401, path
    assert asked(access, "/", ("Cookie", f"avatar_token={TOKEN}")) == 401, "a browser sends cookies to every port"
    assert asked(access, "/\udcff\udcfe") == asked(access, "/?token=%ff%00") == 401


def test_the_printed_address_leads_to_the_page() -> None:
    refusal = HERE.refusal(f"/?token={TOKEN}", Headers(Host="127.0.0.1:8080"))
    assert refusal is not None and refusal.status == 303 and refusal.location == f"./{TOKEN}/"


def test_pages_of_other_sites_are_kept_out() -> None:
    for ours in ("http://127.0.0.1:8080", "https://127.0.0.1:8080", "HTTP://127.0.0.1:8080"):
        assert asked(HERE, f"/{TOKEN}/", origin(ours)) == 200
    others = (
        "http://evil.example",
        "null",
        "",
        "http://127.0.0.1:8081",
        "http://[::1",
        "file://",
        "http://127.0.0.1:8080/x",
    )
    for other in others:
        assert asked(HERE, f"/{TOKEN}/", origin(other)) == asked(EVERYWHERE, f"/{TOKEN}/", origin(other)) == 403, other
    assert asked(HERE, f"/{TOKEN}/", origin("http://127.0.0.1:8080"), origin("http://evil.example")) == 400


def test_a_name_that_was_made_to_point_here_is_kept_out() -> None:
    for ours in ("localhost", "localhost:9000", "127.0.0.1:8080", "[::1]:8080", "LOCALHOST:8080"):
        assert asked(HERE, host=ours) == 200, ours
    for other in ("evil.example:8080", "127.0.0.1.evil.example", "localhost.evil.example:8080", "192.168.0.7:8080"):
        assert asked(HERE, host=other) == 403, other
    for broken in ("", "[::1", "a b", "localhost:8080:1", "user@localhost", "localhost/", "localhost:123456"):
        assert asked(HERE, host=broken) == asked(EVERYWHERE, host=broken) == 400, broken
    assert HERE.refusal(f"/{TOKEN}/", Headers()) is not None
    assert asked(EVERYWHERE, f"/{TOKEN}/", origin("http://192.168.0.7:8080"), host="192.168.0.7:8080") == 200


def test_a_proxy_that_was_named_is_let_in() -> None:
    """Row 24 of the public reports: a proxy's own Host, or the one that it keeps; and a sub-path."""
    access, page = AccessCheck(TOKEN, True, "https://hub.example.org/proxy/8080/"), origin("https://hub.example.org")
    assert asked(access, f"/{TOKEN}/", page) == 200, "nginx writes a Host of its own"
    assert asked(access, f"/{TOKEN}/", page, host="hub.example.org") == 200, "it is kept"
    assert asked(access, f"/proxy/8080/{TOKEN}/", page) == 200, "the sub-path is kept"
    assert asked(access, f"/{TOKEN}/", origin("https://evil.example")) == 403
    assert asked(access, f"/{TOKEN}/", origin("http://hub.example.org")) == 403
    assert asked(access, "/", page) == 401
