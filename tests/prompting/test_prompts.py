"""The page on prompting shows the prompts that are sent."""

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from knotgym.prompting.sample_prompt import sample_prompt

from knotgym.datasets.image_table import decode, encode
from knotgym.envs.tasks import TaskConfig
from knotgym.prompting.chat import ChatConfig
from knotgym.prompting.prompted_episodes import PromptConfig
from knotgym.prompting.prompts import MODES, as_text, first
from knotgym.topology.crossings import label

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def drawing() -> dict[str, Any]:
    """The script that draws the first picture."""
    return runpy.run_path(str(DOCS / "first_picture.py"))


def test_the_first_picture_shows_the_code_of_its_rope(drawing: dict[str, Any]) -> None:
    assert str(label(drawing["example_rope"]())) == "1+,1-,2-,2+"


def test_the_first_picture_is_the_page_s_and_the_script_s(drawing: dict[str, Any]) -> None:
    sent, drawn = decode(first().png).astype(int), drawing["first_picture"]()
    assert (DOCS / "first-picture.png").read_bytes() == first().png
    assert np.abs(sent - drawn).mean() < 2  # letters differ among OpenCV's versions


@pytest.mark.parametrize("mode", MODES)
def test_the_page_shows_the_whole_prompt_of_every_mode(mode: str, states_path: str) -> None:
    task = TaskConfig(task="tie", states=states_path, image_size=16)
    config = PromptConfig(mode=mode, chat=ChatConfig(model="m"), task=task)
    said, shown = sample_prompt(config, [{"image": encode(decode(first().png)[:16, :16])}])
    text = as_text(said, {one.sha256: one.name for one in shown})
    assert f"```text\n{text}```\n" in (DOCS / "prompting.md").read_text(encoding="utf-8")
