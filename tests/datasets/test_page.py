"""Tests of the HTML page of a dataset: its contents, and that a stranger's text stays text."""

from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest_types import Patch
from synthetic_episodes import TASK, TINY, episodes, written

import knotgym.datasets.page as data_module
from knotgym.common import InvalidInput
from knotgym.datasets import open_episodes
from knotgym.datasets.located import Located
from knotgym.datasets.page import _page_data, _page_html
from knotgym.states import States, write_states

HOSTILE = "</script><img src=http://a/ onerror=fault()>"


class Tags(HTMLParser):
    """Collects the tags and links of a page, and its block of data."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.names: list[str] = []
        self.links: list[str] = []
        self.data = ""
        self._inside = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.names.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]
        self._inside = ("id", "data") in attrs

    def handle_endtag(self, tag: str) -> None:
        self._inside = False

    def handle_data(self, data: str) -> None:
        self.data += data if self._inside else ""


def hostile(states: States) -> States:
    """States with markup in their text columns."""
    return states.replaced({"knot": np.array([HOSTILE] * len(states))})


@pytest.fixture(scope="module")
def shown(states_path: str) -> dict[str, Any]:
    return _page_data("run", Located(Path(), Path(states_path), (TINY["expert"],)))


def test_a_page_holds_all_states_and_episodes(states: States, shown: dict[str, Any]) -> None:
    assert len(shown["states"]) == len(states) and len(shown["episodes"]) == 3
    assert shown["says"] == f"{len(states)} states, 3 episodes"
    (own, steps), offsets = (made := open_episodes(TINY["expert"]).episodes), made.offsets
    one, pulls = shown["episodes"][1], slice(offsets[1], offsets[2] - 1)
    assert one["bead"] == [-1, *steps["bead"][pulls].tolist()]
    assert one["rewards"] == steps["reward"][pulls].tolist()
    assert one["seed"] == str(own["seed"][1]) and one["success"] is True
    count = int(own["length"][1]) + 1
    whole = np.frombuffer(base64.b64decode(one["points"]), "<i2").reshape(count, -1, 3)
    laid = steps["observation"][offsets[1] : offsets[2]].astype(float)
    laid -= laid.mean(axis=1, keepdims=True)
    assert np.abs(shown["unit"] * whole - laid).max() < 0.51 * shown["unit"]
    told = re.findall(r"(\d+) reached, (\d+) failed", dict(shown["about"])["by goal"])
    episodes = shown["episodes"]
    assert sum(int(done) for done, _ in told) == sum(one["success"] for one in episodes)
    assert sum(int(one) for pair in told for one in pair) == len(episodes)


def test_crossings_of_a_page_spell_the_code(shown: dict[str, Any]) -> None:
    for row in shown["states"]:
        visits = [
            (place, f"{label}{'+-'[under]}{'ac'[sign > 0]}")
            for label, (*places, sign) in enumerate(row["x"], 1)
            for under, place in enumerate(places)
        ]
        assert ",".join(visit for _, visit in sorted(visits)) == row["code"]


def test_nothing_in_a_file_becomes_markup(states: States, tmp_path: Path) -> None:
    write_states(tmp_path / "s.h5", hostile(states))
    harmful = written(tmp_path / "e.h5", episodes([2], policy=HOSTILE), TASK)
    plain = Tags(_page_html(_page_data("plain", Located(tmp_path, tmp_path / "s.h5"))))
    marked = Tags(_page_html(_page_data(HOSTILE, Located(tmp_path, tmp_path / "s.h5"))))
    played = Tags(_page_html(_page_data("plain", Located(tmp_path, episodes=(harmful,)))))
    assert marked.names == plain.names == played.names
    assert json.loads(marked.data)["states"][0]["knot"] == HOSTILE
    assert json.loads(played.data)["episodes"][0]["policy"] == HOSTILE


def test_a_large_set_is_sampled_and_says_so(states_path: str, monkeypatch: Patch) -> None:
    monkeypatch.setattr(data_module, "MOST_STATES", 3)
    monkeypatch.setattr(data_module, "MOST_FRAMES", 7)
    monkeypatch.setattr(data_module, "MOST_STEPS", 2)
    data = _page_data("run", Located(Path(), Path(states_path), tuple(TINY.values())))
    assert len(data["states"]) == 3
    assert sum(len(one["code"]) for one in data["episodes"]) <= 7
    notices = " ".join(data["notices"])
    assert "Showing 3 of" in notices and "of 6 episodes" in notices and "first 2 steps" in notices


def test_a_file_without_rows_has_no_page(states: States, tmp_path: Path) -> None:
    write_states(tmp_path / "s.h5", states.take(np.arange(0)))
    with pytest.raises(InvalidInput, match="nothing to show"):
        _page_data("empty", Located(tmp_path, tmp_path / "s.h5"))
