"""Configurations refuse invalid values in one line and survive a round trip through JSON."""

import json
from dataclasses import fields
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import pytest
from pydantic import NonNegativeInt, PositiveInt

from knotgym.common import Distinct, Mark
from knotgym.common.configurations import Seed, as_json, configuration, from_json
from knotgym.common.errors import InvalidInput, KnotgymError
from knotgym.drawing import DrawingConfig
from knotgym.envs import TaskConfig
from knotgym.quality import Limits
from knotgym.rendering import AppearanceConfig, PictureConfig
from knotgym.rope import RopeConfig

CONFIGURATIONS = (AppearanceConfig, DrawingConfig, Limits, PictureConfig, RopeConfig)


@configuration
class Inner:
    size: PositiveInt = 3
    range: tuple[float, float] = (0.0, 1.0)


@configuration
class Outer:
    nx: Annotated[tuple[NonNegativeInt, ...], Distinct] = (3,)
    seed: Seed = 0
    kind: Literal["a", "b"] = "a"
    colour: Literal["published"] | tuple[int, int] = "published"
    inner: Inner = Inner(size=7)
    other: Inner | None = None

    def __post_init__(self) -> None:
        if self.inner.size == 99:
            raise InvalidInput("99 is taken")


def numbers(kind: type) -> list[str]:
    """The fields of a configuration that hold a number."""
    return [one.name for one in fields(kind) if type(one.default) in (int, float)]


@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind in CONFIGURATIONS for name in numbers(kind)]
)
@pytest.mark.parametrize("nonsense", [float("nan"), "1"])
def test_numbers_of_any_configuration_refuse_nonsense(kind: type, name: str, nonsense: Any) -> None:
    with pytest.raises(KnotgymError, match=name) as refused:
        kind(**{name: nonsense})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"nx": [2, 2]}, r"nx must be at least one, each once, got \[2, 2\]"),
        ({"inner": {"size": 0}}, "inner.size must be above 0, got 0"),
        ({"inner": {"mood": 1}}, "Inner has no field 'inner.mood'; it has size, range"),
        ({"inner": {"size": 99}}, "^99 is taken$"),
        ({"mood": 1}, "Outer has no field 'mood'; it has nx, seed"),
        ({"colour": [1]}, "colour must be 'published' or"),
        ({"seed": object()}, "Outer is made of JSON values"),
    ],
)
def test_a_value_that_is_wrong_is_named_with_its_path(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        from_json(Outer, values)
    with pytest.raises(InvalidInput, match="TaskConfig needs the field 'task'"):
        from_json(TaskConfig, {})


def test_values_left_out_have_the_defaults_of_their_place() -> None:
    assert from_json(Outer, {"inner": {"range": [1, 2]}}).inner == Inner(size=7, range=(1, 2))
    assert from_json(Outer, {"other": {}}).other == Inner(size=3)


@pytest.mark.parametrize("kind", CONFIGURATIONS)
def test_a_configuration_comes_back_from_json(kind: Any) -> None:
    assert from_json(kind, json.loads(json.dumps(as_json(kind())))) == kind()


def test_numbers_of_numpy_are_plain_ones() -> None:
    config = Outer(seed=np.int32(5), inner=Inner(range=(np.float32(0.5), np.float64(1))))  # type: ignore[arg-type]
    assert type(config.seed) is int and type(config.inner.range[0]) is float


def test_a_name_stands_for_a_configuration_that_is_named_by_a_field() -> None:
    @configuration
    class Named:
        NAMED_BY: ClassVar = "name"
        name: str = "a"

    @configuration
    class Holder:
        one: Named = Named()
        many: tuple[Named, ...] = ()

    held: Any = {"one": "b", "many": ("c", Named(name="d"))}
    assert Holder(**held) == Holder(one=Named(name="b"), many=(Named(name="c"), Named(name="d")))
    with pytest.raises(InvalidInput, match="one must be an instance of Named, got 3"):
        Holder(**dict[str, Any](one=3))


def test_every_field_of_a_task_has_one_role() -> None:
    task = TaskConfig(task="tie")
    roles = [n for role in ("rules", "physics", "view", "look") for n in Mark.values(task, role)]
    assert sorted(roles) == sorted(one.name for one in fields(TaskConfig))
