"""HTML from Python values, escaped unless it is Markup already; and the page around it."""

from __future__ import annotations

import base64
import hashlib
import html
from collections.abc import Iterable
from pathlib import Path

STYLESHEET = Path(__file__).with_name("style.css")
_VOID = ("img", "input", "br", "hr", "meta")  # elements without content


class Markup(str):
    """Text that is HTML. Only `element`, `join` and constants of this package may make one."""

    __slots__ = ()


Content = str | float | None | Markup
Attribute = str | float | bool | None


def escape(value: Content) -> Markup:
    """`value` as HTML text; Markup stays as it is, None is nothing."""
    if isinstance(value, Markup):
        return value
    return Markup("" if value is None else _escape(str(value)))


def _escape(text: str) -> str:
    """A path may hold what is not Unicode, which no page can show."""
    return html.escape(text.encode(errors="backslashreplace").decode(), quote=True)


def join(parts: Iterable[Content]) -> Markup:
    return Markup("".join(escape(part) for part in parts))


def element(tag: str, *content: Content, **attributes: Attribute) -> Markup:
    """`<tag attribute="...">content</tag>`. A trailing underscore of an attribute's name is dropped (`class_`), others
    become hyphens (`data_index`); True stands for an attribute without value, None and False for none."""
    words = [tag]
    for name, value in attributes.items():
        if value is None or value is False:
            continue
        name = name.rstrip("_").replace("_", "-")
        words.append(name if value is True else f'{name}="{_escape(str(value))}"')
    opening = f"<{' '.join(words)}>"
    return Markup(opening if tag in _VOID else f"{opening}{join(content)}</{tag}>")


def document(title: str, body: Iterable[Content], script: str = "") -> str:
    """A whole page. Its content security policy forbids every request and every script but `script`.

    `script` must not contain `</script`.
    """
    if "</script" in script.lower():
        raise ValueError("the script must not contain '</script'")
    style = STYLESHEET.read_text(encoding="utf-8")
    sources = {"style-src": f"'{_hash(style)}'", "img-src": "data:", "media-src": "data:"}
    if script:
        sources["script-src"] = f"'{_hash(script)}'"
    policy = "; ".join(["default-src 'none'", *(f"{name} {source}" for name, source in sources.items())])
    head = join(
        (
            element("meta", charset="utf-8"),
            element("meta", http_equiv="Content-Security-Policy", content=policy),
            element("meta", name="viewport", content="width=device-width, initial-scale=1"),
            element("title", title),
            element("style", Markup(style)),
        )
    )
    ending = element("script", Markup(script)) if script else ""
    content = element("html", element("head", head), element("body", element("main", *body), ending), lang="en")
    return f"<!doctype html>\n{content}\n"


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
