"""Pages: nothing gets in unescaped, nothing is fetched."""

from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest

from avatar.html import data_table, document, element, figure_of, join, picture, plot, section, tiles
from avatar.html.parts import data_uri

NASTY = "<script>alert(\"x\")</script> & 'y'"
SAFE = "&lt;script&gt;alert(&quot;x&quot;)&lt;/script&gt; &amp; &#x27;y&#x27;"


def test_text_and_attributes_are_escaped_once() -> None:
    assert element("p", NASTY) == f"<p>{SAFE}</p>"
    assert element("p", element("b", NASTY)) == f"<p><b>{SAFE}</b></p>"
    assert element("a", title=NASTY) == f'<a title="{SAFE}"></a>'
    assert join(("<", element("i", ">"))) == "&lt;<i>&gt;</i>"
    assert SAFE in tiles({"name": NASTY}) and SAFE in data_table([NASTY], []) and SAFE in data_table([], [[NASTY]])
    page = document(NASTY, [NASTY])
    assert "<script>" not in page and page.count(SAFE) == 2
    assert f"<title>{SAFE}</title>" in page and f"<main>{SAFE}</main>" in page
    assert f"<figcaption>{SAFE}</figcaption>" in plot(figure_of()[0], NASTY)
    assert element("p", None, 0.0) == "<p>0.0</p>" and section("a", "b") == "<section><h2>a</h2>b</section>"


def test_attribute_names_and_values() -> None:
    assert element("img", src="x", hidden=True, alt=None, draggable=False) == '<img src="x" hidden>'
    assert element("input", class_="a", data_index=3) == '<input class="a" data-index="3">'


def test_numbers_stand_to_the_right() -> None:
    assert '<td class="number">1.5</td><td>a</td>' in data_table(["x", "y"], [[1.5, "a"]])


def test_columns_without_anything_are_left_out() -> None:
    table = data_table(["x", "y", "z"], [["a", "-", 0.0], ["-", None, None]])
    assert "<th>x</th><th>z</th>" in table and '<td>a</td><td class="number">0.0</td>' in table
    assert "<th>y</th>" in data_table(["x", "y"], []), "without rows nothing is known"
    assert 'tabindex="0"' in table, "the arrow keys scroll it"


def test_an_image_comes_back_from_its_url() -> None:
    image = np.full((5, 7, 3), (200, 100, 50), np.uint8)
    head, _, data = data_uri(image).partition(",")
    assert head == "data:image/jpeg;base64"
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_allclose(decoded[..., ::-1].astype(int), image, atol=3)
    assert SAFE in picture(image, NASTY)


def test_the_policy_forbids_all_but_the_pages_own_script() -> None:
    assert "default-src &#x27;none&#x27;" in document("t", [])
    assert '<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="default-src' in document("t", [])
    assert '<meta name="viewport" content="width=device-width' in document("t", [])
    assert "script-src" not in document("t", [])
    assert "script-src &#x27;sha256-" in document("t", [], "let a = 1 < 2;")
    assert "</main><script>let a = 1 < 2;</script>" in document("t", [], "let a = 1 < 2;"), "what it looks for is there"
    with pytest.raises(ValueError, match="must not contain"):
        document("t", [], "'</SCRIPT>'")


def test_a_path_that_is_not_utf_8_is_shown_as_far_as_it_can_be() -> None:
    page = document("caf\udce9", [element("p", "caf\udce9", title="caf\udce9")])
    assert page.encode().count(b"caf\\udce9") == 3
