"""Configurations reject invalid values and survive a round trip through JSON."""

import json
from dataclasses import asdict, fields, replace
from typing import Any

import pytest

from knotgym.common.configuration import check_numbers, from_json
from knotgym.common.errors import InvalidInput, KnotgymError
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policies import PolicyConfig
from knotgym.control.transition_graph import TransitionGraphConfig
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.collect import CollectConfig
from knotgym.generate.images.images_config import ImagesConfig
from knotgym.generate.images.selection import SelectionConfig
from knotgym.generate.images.walks import WalkConfig
from knotgym.generate.states.archive import ArchiveConfig
from knotgym.generate.states.generate_config import GenerateConfig
from knotgym.generate.states.search import SearchSettings
from knotgym.generate.states.state_recipe import StateRecipe
from knotgym.quality.label_limits import LabelLimits
from knotgym.rope.macro_actions import MacroActionConfig
from knotgym.rope.relaxation import RelaxationConfig

TUNED = (
    ArchiveConfig,
    LabelLimits,
    MacroActionConfig,
    PlannerConfig,
    RelaxationConfig,
    SearchSettings,
    SelectionConfig,
    TransitionGraphConfig,
    WalkConfig,
)


def numbers(kind: type) -> list[str]:
    """The fields of a configuration that hold a number."""
    return [field.name for field in fields(kind) if isinstance(field.default, (int, float))]


@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind in TUNED for name in numbers(kind)]
)
@pytest.mark.parametrize("nonsense", [float("nan"), float("inf"), -1])
def test_every_number_of_every_configuration_refuses_nonsense(
    kind: type, name: str, nonsense: float
) -> None:
    with pytest.raises(KnotgymError, match=name) as refused:
        kind(**{name: nonsense})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "settings",
    [{"relaxations": ((0, 3),)}, {"relaxations": ((5, 3),)}, {"gentle": 1.5}],
)
def test_walks_that_make_no_sense_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(InvalidInput):
        WalkConfig(**settings)


def test_a_search_must_have_room_to_set_out() -> None:
    with pytest.raises(InvalidInput, match="longest must be at least room"):
        SearchSettings(longest=3)


def test_the_error_raised_is_the_one_asked_for() -> None:
    class InvalidThing(KnotgymError):
        pass

    with pytest.raises(InvalidThing, match="kept must be"):
        check_numbers(ArchiveConfig(kept=5), ranges=(), shares=("kept",), error=InvalidThing)


@pytest.mark.parametrize(
    "config",
    [
        GenerateConfig(nx=(2, 3), search=SearchSettings(archive=ArchiveConfig(kept=3))),
        ImagesConfig(nx=(0, 1), walk=WalkConfig(relaxations=((1, 2),))),
        CollectConfig(
            task=TaskConfig(task="tie"),
            policy=PolicyConfig(
                policy="expert",
                planner=PlannerConfig(macro_actions=MacroActionConfig(distance=(0.1, 0.2))),
            ),
        ),
    ],
    ids=lambda config: type(config).__name__,
)
def test_a_configuration_comes_back_from_json(config: Any) -> None:
    assert from_json(type(config), json.loads(json.dumps(asdict(config)))) == config


def test_a_value_without_a_field_is_refused() -> None:
    with pytest.raises(InvalidInput, match="ArchiveConfig: no field 'mood'; there is kept, fair"):
        from_json(ArchiveConfig, {"kept": 2, "mood": 1})


def test_the_search_of_a_run_has_every_setting_of_its_configuration() -> None:
    settings = SearchSettings(batch_size=8, steps=7, longest=30, jitter=0.1)
    config = replace(GenerateConfig(seed=5), search=settings)
    search = StateRecipe(config).search
    assert {name: getattr(search, name) for name in vars(settings)} == vars(settings)
    assert search.seed == 5 and search.max_nx == 3
