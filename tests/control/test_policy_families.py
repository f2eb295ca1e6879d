"""Packages above `control` provide policies by entry points, and nothing below names them."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from knotgym.common.errors import InvalidPolicy
from knotgym.control import policies
from knotgym.control.old_basic_policies import ConstantPolicy
from knotgym.control.policies import PolicyFamily, make_policy, policy_digests, training_card
from knotgym.control.policy_config import PolicyConfig

from ..fresh_interpreter import ROOT, modules_after

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
MODULE = re.compile(r"knotgym\.(\w+)[\w.:]*")

still = PolicyFamily(
    form="still:WORD",
    matches=lambda name: name.startswith("still:"),
    make=lambda config: ConstantPolicy([0.0] * 6),
    files=lambda name: {"this": Path(__file__)},
    card=lambda name: {"word": name.partition(":")[2]},
)


@pytest.fixture
def provided(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[EntryPoint]]:
    """The installed entry points, empty at first."""
    found: list[EntryPoint] = []
    monkeypatch.setattr(policies, "entry_points", lambda group: found)
    monkeypatch.setattr(policies, "_CHECKOUT", ROOT / "pyproject.toml")
    policies._entry_point_families.cache_clear()
    monkeypatch.setitem(sys.modules, "still_policies", sys.modules[__name__])
    yield found
    policies._entry_point_families.cache_clear()


def test_another_package_s_family_makes_policies(provided: list[EntryPoint]) -> None:
    provided.append(EntryPoint("still", "still_policies:still", policies.GROUP))
    config = PolicyConfig(policy="still:now")
    assert isinstance(make_policy(config), ConstantPolicy)
    assert list(policy_digests(config)) == ["this"]
    assert training_card("still:now") == {"word": "now"} and training_card("random") is None
    with pytest.raises(InvalidPolicy, match="mixed, .* still:WORD"):
        PolicyConfig(policy="genius")


def test_a_family_that_cannot_be_loaded_is_named_in_one_line(provided: list[EntryPoint]) -> None:
    provided.append(EntryPoint("broken", "no_such_module:family", policies.GROUP))
    with pytest.raises(InvalidPolicy, match="broken = no_such_module:family") as refused:
        PolicyConfig(policy="pretrained")
    assert "\n" not in str(refused.value)
    PolicyConfig(policy="random")


@pytest.mark.parametrize("policy", ["pretrained", "prompt:transcripts.jsonl"])
def test_a_checkout_that_is_not_installed_has_the_package_s_families(
    policy: str, provided: list[EntryPoint]
) -> None:
    assert PolicyConfig(policy=policy).policy == policy and not provided


@pytest.mark.thorough
def test_a_policy_s_name_is_checked_without_torch() -> None:
    made = "from knotgym.control.policies import PolicyConfig; PolicyConfig(policy='pretrained')"
    assert "torch" not in modules_after(made)


@pytest.mark.thorough
def test_no_module_names_one_of_a_room_above_it() -> None:
    contract = PROJECT["tool"]["importlinter"]["contracts"][0]
    floors = {
        room.strip().removeprefix("knotgym."): -height
        for height, layer in enumerate(contract["layers"])
        for room in layer.split("|")
    }
    climbs = []
    for file in sorted((ROOT / "knotgym").rglob("*.py")):
        room = file.relative_to(ROOT / "knotgym").parts[0]
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Constant):
                continue
            named = MODULE.fullmatch(str(node.value))
            if named and floors.get(named[1], -99) > floors.get(room, 0):
                climbs.append(f"{file.relative_to(ROOT)}:{node.lineno} {named[0]}")
    assert floors["learn"] > floors["control"] and climbs == []
