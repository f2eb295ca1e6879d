"""The page on prompting shows the prompts that are sent."""

import runpy
from pathlib import Path
from typing import Any

import pytest

from knotgym.datasets import decode, encode
from knotgym.envs import TaskConfig
from knotgym.prompting.chat import ChatConfig
from knotgym.prompting.prompt_run import sample_prompt
from knotgym.prompting.prompts import FIRST, MODES, PromptConfig
from knotgym.topology import label

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def drawing() -> dict[str, Any]:
    """The script that draws the first picture."""
    return runpy.run_path(str(DOCS / "first_picture.py"))


def test_the_first_picture_shows_the_code_of_its_rope(drawing: dict[str, Any]) -> None:
    assert str(label(drawing["example_rope"]())) == "1+,1-,2-,2+"


@pytest.mark.parametrize("mode", [mode for mode in MODES if mode != "stateful"])
def test_the_page_shows_the_whole_prompt_of_every_mode(mode: Any) -> None:
    task = TaskConfig(task="tie", image_size=16)
    config = PromptConfig(mode=mode, chat=ChatConfig(model="m"), task=task)
    rows = [{"image": encode(decode(FIRST.png)[:16, :16])}] if mode == "read" else []
    text, pictures = sample_prompt(config, rows)
    assert pictures["picture-1"] == FIRST.png and f"[{[*pictures][-1]}]" in text
    assert f"```text\n{text}```\n" in (DOCS / "prompting.md").read_text(encoding="utf-8")
