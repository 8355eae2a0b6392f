"""A browser, a small avatar and its page for the tests of pages."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browsers import chromium
from lively import lively_avatar

from avatar.export.web_page import write_page
from avatar.runs.trained_avatar import TrainedAvatar


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as opened:
        yield opened


@pytest.fixture(scope="session")
def trained(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    return lively_avatar(tracked_folder, tmp_path_factory.mktemp("runs") / "run", "model.uv_size=20")


@pytest.fixture(scope="module")
def page_file(trained: TrainedAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_page(trained, tmp_path_factory.mktemp("page") / "someone.html").path


@pytest.fixture
def visit(browser: Any, page_file: Path) -> Iterator[Any]:
    """Opens the page with a query and with options of the browser's context."""
    contexts, wrong = [], []

    def visited(query: str = "", **options: Any) -> Any:
        context = browser.new_context(offline=True, **{"viewport": {"width": 1100, "height": 760}, **options})
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.goto(f"{page_file.as_uri()}?width=64{query}")
        page.locator("#message").wait_for(state="hidden", timeout=20000)
        return page

    yield visited
    for context in contexts:
        context.close()
    assert not wrong
