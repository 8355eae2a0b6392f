"""The page of `avatar check --out`."""

from __future__ import annotations

import csv
import os
from html.parser import HTMLParser
from pathlib import Path

import pytest
from access import audited
from browsers import chromium
from folder_damage import all_zero
from tracked_folder import write_tracked_folder

from avatar.cli import main
from data_prep.check.folder import Check
from data_prep.check.page import check_page_output, render_page


class Sources(HTMLParser):
    """Everything that a browser would load, and the text."""

    def __init__(self) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = [value or "" for name, value in attrs if name in ("src", "href", "srcset", "poster", "data")]
        self.sources += [value for value in named if not value.startswith("#")]

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    name = "so <me> & one" + os.fsdecode(b"\xeb")  # not UTF-8 at the end
    folder = write_tracked_folder(tmp_path_factory.mktemp("page") / "folder", 24)
    folder = folder.rename(folder.with_name(name))
    all_zero(5)(folder)
    out = folder.parent / "out"
    assert main(["check", str(folder), "--frame-offset", "1", "--out", str(out)]) == 1
    return out / "index.html"


def test_the_page_holds_pictures_and_findings_and_loads_nothing(page: Path) -> None:
    parsed = Sources()
    parsed.feed(page.read_text(encoding="utf-8"))
    assert len(parsed.sources) == 8 + 6  # overlays, plots
    assert all(source.startswith(("data:image/png;base64,", "data:image/jpeg;base64,")) for source in parsed.sources)
    assert "Check of so <me> & one" in parsed.text
    assert "The tracking cannot be used in frame 00005 of checkpoint: all zero" in parsed.text
    assert str(page.parents[1]) not in parsed.text
    assert page.stat().st_size < 3e6


@pytest.mark.parametrize("name", ["index.html", "frames.csv"])
def test_a_file_of_somebody_else_stays(
    name: str, tracked_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / name
    other.write_text("mine")
    assert main(["check", str(tracked_folder), "--out", str(tmp_path)]) == 2
    assert f"{other} is not of avatar check" in capsys.readouterr().err
    assert other.read_text() == "mine" and [*tmp_path.iterdir()] == [other]


def test_an_earlier_page_is_written_again(page: Path) -> None:
    check_page_output(page.parent)


def test_pictures_and_main_figures_come_before_the_findings(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    link, tiles, picture, findings, quoted = map(
        text.index, ('href="#findings"', "<dt>usable frames</dt>", "<img", 'id="findings"', "all zero")
    )
    assert link < tiles < picture < findings < quoted


def test_a_folder_that_cannot_be_read_shows_its_findings(tmp_path: Path) -> None:
    assert main(["check", str(tmp_path / "nothing"), "--out", str(tmp_path / "out")]) == 2
    text = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "<img" not in text and 'class="finding error"' in text


def test_the_title_names_what_avatar_create_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (subject := tmp_path / "me" / "subject").mkdir(parents=True)
    monkeypatch.chdir(subject)
    for folder in (subject, Path()):
        page = render_page(Check(folder, (), None, None))
        assert "<title>Check of me</title>" in page and "<h1>Check of me</h1>" in page


def test_the_table_has_a_line_for_every_image(page: Path) -> None:
    rows = list(csv.DictReader((page.parent / "frames.csv").open()))
    assert [row["image"] for row in rows] == [f"{n:05d}.jpg" for n in range(1, 25)]
    assert rows[0]["change"] == "" and all(0 < float(row["change"]) < 30 for row in rows[1:])
    assert rows[5]["overlap"] == "" and all(float(row["overlap"]) > 0.99 for row in rows if row["image"] != "00006.jpg")


@pytest.mark.chromium
def test_a_browser_shows_it_without_complaint_and_axe_finds_nothing(page: Path) -> None:
    with chromium() as browser:
        opened, wrong = browser.new_page(), []
        opened.on("console", lambda said: wrong.append(said.text))
        opened.goto(page.as_uri())
        assert opened.evaluate("[...document.images].filter((one) => one.naturalWidth > 0).length") == 14
        assert opened.evaluate("document.images[0].getBoundingClientRect().bottom") < 800
        assert audited(opened) == []
    assert not wrong
