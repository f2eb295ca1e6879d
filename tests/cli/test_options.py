"""Options come from the configuration that they set: what a user types counts first, then a
--settings file, then the default of the field.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import typer

from knotgym.cli import main as cli
from knotgym.cli.options import field_help, options_of
from knotgym.generate.episodes.collect import CollectConfig
from knotgym.generate.episodes.evaluate import EvaluateConfig
from knotgym.prompting.prompted_episodes import PromptConfig

from ..small_job import knotgym

TOML = 'episodes = 3\npolicies = [{policy = "scripted"}]\n[task]\nhorizon = 9\nhold = 2\n'


@pytest.fixture
def configs(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The configurations that commands were run with, instead of running them."""
    found: list[Any] = []
    monkeypatch.setattr(
        "knotgym.generate.episodes.evaluate.run", lambda config, *_, **__: found.append(config)
    )
    monkeypatch.setattr(
        "knotgym.generate.episodes.collect.run", lambda recipe, *_: found.append(recipe.config)
    )
    return found


def test_a_settings_file_gives_what_was_not_typed(configs: list[Any], tmp_path: Path) -> None:
    toml, as_json = tmp_path / "a.toml", tmp_path / "a.json"
    toml.write_text(TOML, encoding="utf-8")
    as_json.write_text(
        json.dumps(
            {
                "episodes": 3,
                "policies": [{"policy": "scripted"}],
                "task": {"horizon": 9, "hold": 2},
            }
        )
    )
    for file in (toml, as_json):
        assert knotgym("evaluate", "--settings", file, "--horizon", 7, "--quiet") == 0
    assert configs[0] == configs[1]
    (config, _) = configs
    assert (config.episodes, config.task.horizon, config.task.hold) == (3, 7, 2)
    assert [one.policy for one in config.policies] == ["scripted"]
    assert config.task.observation == "state"  # the default of evaluate, not of an environment


def test_a_policy_that_is_typed_replaces_those_of_the_file(
    configs: list[Any], tmp_path: Path
) -> None:
    file = tmp_path / "a.toml"
    file.write_text(TOML, encoding="utf-8")
    words = ("--policy", "expert", "--policy", "random", "--budget", 50)
    assert knotgym("evaluate", "--settings", file, *words, "--quiet") == 0
    (config,) = configs
    assert [(one.policy, one.planner.budget) for one in config.policies] == [
        ("expert", 50),
        ("random", 50),
    ]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("epochs = 3", "EvaluateConfig has no field 'epochs'; it has policies, tasks"),
        ("[task]\nhorizon = 'x'", "task.horizon must be a whole number, got 'x'"),
        ("task = 3", "task must be an object, got 3"),
        ("= 3", "can't be read as TOML"),
    ],
)
def test_a_mistake_in_a_settings_file_is_one_line(
    text: str, told: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "a.toml"
    file.write_text(text, encoding="utf-8")
    assert knotgym("evaluate", "--settings", file) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert told in line


def test_a_camera_and_settings_name_a_collection_apart(configs: list[Any], tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("attempts = 2\n", encoding="utf-8")
    words = ("--policy", "random", "--out", tmp_path, "--quiet")
    assert knotgym("collect", *words) == 0
    assert knotgym("collect", *words, "--camera", "perspective") == 0
    assert knotgym("collect", *words, "--settings", tmp_path / "a.toml") == 0
    plain, perspective, best = (config.dataset_id for config in configs)
    assert plain == "knotgym/tie-nx2/random-v0" and best == "knotgym/tie-nx2/random-best2-v0"
    assert perspective.startswith("knotgym/tie-nx2/random-rules")
    assert configs[1].task.camera == "perspective"


def test_every_option_says_what_it_does_and_has_the_default_of_its_field() -> None:
    app: Any = typer.main.get_command(cli.app)
    for name in ("collect", "evaluate", "generate", "images", "suite", "train", "prompt", "demo"):
        for parameter in app.commands[name].params:
            assert (parameter.help or "").endswith("."), (name, parameter.name)
    config: Any
    for name, config in (("collect", CollectConfig()), ("evaluate", EvaluateConfig())):
        defaults = {one.name: one.default for one in app.commands[name].params}
        assert defaults["episodes"] == config.episodes
        assert defaults["task__reset_noise"] == config.task.reset_noise
        assert defaults["policy__planner__budget"] == 60000


def test_a_field_that_several_names_describe_has_their_help() -> None:
    class Pair:
        """Two numbers.

        Attributes:
            low, high: ends of the range, `low` first; e.g. 1,2. Never equal.
            other: another
                thing.
        """

    assert field_help(Pair, "high") == "Ends of the range, `low` first; e.g. 1,2."
    assert field_help(Pair, "other") == "Another thing." and field_help(Pair, "absent") == ""


def test_options_are_spelt_as_users_type_them() -> None:
    shown = {one.path: (one.names, one.default) for one in options_of(EvaluateConfig(), "nx tasks")}
    assert shown == {"nx": ("--nx", "2"), "tasks": ("--tasks", "tie")}
    assert PromptConfig.__dataclass_fields__["mode"].default == "stateless"
