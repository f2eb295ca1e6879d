"""The HTML page of a run in a Chromium: what it draws, and how it answers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from knotgym.datasets.located import Located
from knotgym.datasets.page import _page_data, _page_html
from knotgym.states import States, write_states

from .. import chromium
from ..chromium import Chromium
from ..small_job import knotgym
from .test_page import HOSTILE, hostile


@pytest.fixture(scope="module")
def run_page(curated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the small run."""
    out = tmp_path_factory.mktemp("page") / "page.html"
    assert knotgym("dataset", "page", curated, "--out", out, "--quiet") == 0
    return out


clients = pytest.mark.clients
DRAWN = """(() => {{ const canvas = document.getElementById("{0}"), seen = new Set();
  const dots = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  for (let i = 0; i < dots.length; i += 4) if (dots[i + 3]) seen.add(dots[i] >> 5 << 6 |
    dots[i + 1] >> 5 << 3 | dots[i + 2] >> 5); return seen.size; }})()"""
LOOKS = 'document.getElementById("{0}").toDataURL()'
CARDS = "document.querySelectorAll('.card').length"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    if not chromium.FOUND:
        pytest.skip("there is no Chromium")
    with Chromium(tmp_path_factory.mktemp("profile")) as one:
        yield one


@pytest.fixture
def tab(browser: Chromium) -> Iterator[Chromium]:
    """A desktop browser tab; errors logged in it fail the test."""
    browser.resize(1300, 900)
    browser.faults.clear()
    browser.requests.clear()
    yield browser
    assert browser.faults == []
    assert [one for one in browser.requests if not one.startswith(("file:", "about:"))] == []


@clients
def test_the_states_picture_is_not_blank_and_turns(tab: Chromium, run_page: Path) -> None:
    tab.open(run_page, "#states/6")
    assert tab.ask(DRAWN.format("stage")) > 20 and tab.ask(CARDS) == 8
    before, box = tab.ask(LOOKS.format("stage")), "document.getElementById('stage')"
    x, y = (tab.ask(f"{box}.getBoundingClientRect().{side} + 100") for side in ("left", "top"))
    tab.drag((x, y), (x + 60, y + 90))
    tab.until(f"{LOOKS.format('stage')} !== '{before}'")
    tab.press("t")
    tab.until(f"{LOOKS.format('stage')} === '{before}'")


@clients
def test_filters_filter(tab: Chromium, run_page: Path) -> None:
    tab.open(run_page)
    tab.ask("document.querySelector('[data-filter=nx][data-value=\"1\"]').click()")
    assert tab.ask(CARDS) == 4 and "4 of 8" in tab.ask("document.body.innerText")
    tab.ask("document.querySelector('[data-filter=split][data-value=test]').click()")
    assert tab.ask(CARDS) == 2
    typing = "document.querySelector('[data-filter=code]')"
    tab.ask(f"{typing}.value = '9+'; {typing}.dispatchEvent(new Event('input'))")
    assert tab.ask(CARDS) == 0


@clients
def test_an_episode_plays_to_its_end(tab: Chromium, run_page: Path) -> None:
    tab.open(run_page, "#episodes/2")
    before = tab.ask(LOOKS.format("film"))
    assert tab.ask(DRAWN.format("film")) > 20 and tab.ask(DRAWN.format("time")) > 2
    tab.press("ArrowRight")
    step = "document.querySelector('#episode-facts dd').textContent"
    assert tab.ask(step).startswith("1 of ")
    tab.until(f"{LOOKS.format('film')} !== '{before}'")  # drawn with the next frame
    tab.ask("for (const one of document.querySelectorAll('#episode-tools button'))"
            " if (one.textContent === '1 ×') { one.click(); one.click(); }")  # fmt: skip
    tab.press(" ")
    tab.until(f"((of) => of[0] === of[1])({step}.split(' of '))")


@clients
def test_a_phone_has_no_sideways_scrolling_and_opens_a_state(tab: Chromium, run_page: Path) -> None:
    tab.resize(390, 800, mobile=True)
    tab.open(run_page)
    assert tab.ask("document.documentElement.scrollWidth") <= 390
    tab.ask("document.querySelector('.card').click()")
    assert tab.ask("document.getElementById('stage').getBoundingClientRect().width") > 300
    tab.press("2")
    assert tab.ask("document.documentElement.scrollWidth") <= 390


@clients
def test_markup_of_files_is_text_in_browsers(tab: Chromium, states: States, tmp_path: Path) -> None:
    write_states(tmp_path / "s.h5", hostile(states))
    (tmp_path / "p.html").write_text(
        _page_html(_page_data(HOSTILE, Located(tmp_path, tmp_path / "s.h5"))), encoding="utf-8"
    )
    tab.open(tmp_path / "p.html", "#states/3")
    assert tab.ask("document.querySelectorAll('img').length") == 0
    assert HOSTILE in tab.ask("document.body.innerText")
