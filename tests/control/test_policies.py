import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.cli.main import main
from knotgym.common.atomic_files import sha256
from knotgym.common.errors import InvalidPolicy, KnotgymError
from knotgym.control import policies
from knotgym.control.old_basic_policies import RandomPolicy
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policies import make_policy, policy_digests, register_policy
from knotgym.control.policy_config import MIXED, PolicyConfig
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig

QUICK = PlannerConfig(budget=8, batch_size=2)
OURS = ("random", "constant", "scripted", "expert", "noisy", "mixed")


def act_once(
    config: PolicyConfig, states_path: str, seed: int, count: int = 3
) -> NDArray[np.float32]:
    """Two actions of each of `count` episodes: float32 (count, 2, 6)."""
    task = TaskConfig(task="unknot", nx=2, states=states_path, observation="state")
    episodes, policy = EpisodeBatch(task, count), make_policy(config)
    for index in range(count):
        episodes.begin(index, np.random.default_rng([seed, index]))
        policy.begin(episodes, index, np.random.default_rng([seed, index, 1]))
    actions: list[NDArray[np.float32]] = []
    for _ in range(2):
        if actions:
            episodes.step(actions[0], np.arange(count))
        choice = policy.act(episodes, np.arange(count))
        assert len(choice.moves) == count
        actions.append(choice.actions)
    return np.stack(actions, axis=1)


@pytest.fixture(scope="module")
def acted(states_path: str) -> dict[str, NDArray[np.float32]]:
    """Name of a policy -> what it does with seed 1."""
    return {
        name: act_once(PolicyConfig(policy=name, planner=QUICK), states_path, 1) for name in OURS
    }


@pytest.mark.parametrize("name", [name for name in OURS if name != "expert"])  # noisy or mixed
def test_the_same_seed_gives_the_same_actions(
    name: str, states_path: str, acted: dict[str, NDArray[np.float32]]
) -> None:
    config = PolicyConfig(policy=name, planner=QUICK)
    assert np.array_equal(act_once(config, states_path, 1), acted[name])


@pytest.mark.parametrize("name", ["random", "scripted", "noisy"])
def test_another_seed_gives_other_actions(
    name: str, states_path: str, acted: dict[str, NDArray[np.float32]]
) -> None:
    config = PolicyConfig(policy=name, planner=QUICK)
    assert not np.array_equal(act_once(config, states_path, 2), acted[name])


@pytest.mark.parametrize("name", ["random", "scripted", "mixed"])
def test_what_an_episode_sees_does_not_depend_on_its_neighbours(
    name: str, states_path: str, acted: dict[str, NDArray[np.float32]]
) -> None:
    config = PolicyConfig(policy=name, planner=QUICK)
    assert np.array_equal(act_once(config, states_path, 1, 2), acted[name][:2])


def test_actions_are_float32_inside_the_box(acted: dict[str, NDArray[np.float32]]) -> None:
    for actions in acted.values():
        assert actions.dtype == np.float32 and np.abs(actions).max() <= 1


def test_the_constant_policy_takes_one_action(states_path: str) -> None:
    actions = act_once(PolicyConfig(policy="constant"), states_path, 1)
    assert actions.dtype == np.float32 and (actions == 1).all()


def test_a_noisy_expert_of_noise_one_is_never_the_expert(states_path: str) -> None:
    episodes = EpisodeBatch(
        TaskConfig(task="unknot", nx=2, states=states_path, observation="state")
    )
    policy = make_policy(PolicyConfig(policy="noisy", noise=1.0, planner=QUICK))
    episodes.begin(0, np.random.default_rng(0))
    policy.begin(episodes, 0, np.random.default_rng(1))
    assert policy.act(episodes, np.array([0])).moves == ["noise"]
    assert policy.effort(0).actions == 0


def test_a_mixed_policy_with_one_share_is_that_policy(states_path: str) -> None:
    episodes = EpisodeBatch(TaskConfig(task="tie", nx=2, states=states_path, observation="state"))
    for name in MIXED:
        shares = tuple(float(other == name) for other in MIXED)
        policy = make_policy(PolicyConfig(policy="mixed", shares=shares, planner=QUICK))
        episodes.begin(0, np.random.default_rng(0))
        policy.begin(episodes, 0, np.random.default_rng(1))
        assert policy.name(0) == name


class Counter:
    """Pulls a little harder at every step of an episode: a policy with a memory."""

    def reset(self, generator: np.random.Generator) -> None:
        self.pulls = 0

    def act(self, observation: NDArray[np.float32]) -> list[float]:
        self.pulls += 1
        return [0, 0, 0, self.pulls / 10, float(observation.shape == (600,)), 0]


class Own:
    """A module of the user's."""

    counter, made = Counter, Counter()
    three = 3

    @staticmethod
    def informed(observation: object, info: dict[str, object], rng: object) -> list[float]:
        return [0, 0, 0, float("gauss_code" in info), 0, 0]

    @staticmethod
    def brief(observation: object) -> list[float]:
        return [0, 0, 0, 0.5, 0, 0]

    @staticmethod
    def far(observation: object) -> list[float]:
        return [0, 0, 0, 0, 0, 7.0]

    @staticmethod
    def nothing(observation: object) -> float:
        return float("nan")

    @staticmethod
    def two(observation: object, info: object) -> list[float]:
        return [0.0] * 6

    @staticmethod
    def faulty(observation: object) -> list[float]:
        raise KeyError("no such weight")


@pytest.fixture
def own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "own", Own)


@pytest.mark.parametrize(
    ("name", "pull"), [("informed", 1), ("brief", 0.5), ("counter", 0.1), ("made", 0.1)]
)
def test_functions_and_objects_of_the_user_are_policies(
    states_path: str, own: None, name: str, pull: float
) -> None:
    actions = act_once(PolicyConfig(policy=f"own:{name}"), states_path, 0)
    assert actions[0, 0, 3] == np.float32(pull)


def test_every_episode_has_an_object_of_its_own(states_path: str, own: None) -> None:
    episodes = EpisodeBatch(
        TaskConfig(task="unknot", nx=1, states=states_path, observation="state"), 2
    )
    policy = make_policy(PolicyConfig(policy="own:made"))
    for index in (0, 1):
        episodes.begin(index, np.random.default_rng(index))
        policy.begin(episodes, index, np.random.default_rng(index))
    policy.act(episodes, np.array([0]))
    assert policy.act(episodes, np.array([0, 1])).actions[:, 3].tolist() == pytest.approx(
        [0.2, 0.1]
    )
    policy.begin(episodes, 0, np.random.default_rng(2))
    assert policy.act(episodes, np.array([0])).actions[0, 3] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("far", "must give 6 finite numbers in .* got .*7.0"),
        ("nothing", "must give 6 finite numbers"),
        ("faulty", "own:faulty raised KeyError: 'no such weight' .test_policies.py, line"),
    ],
)
def test_what_a_policy_does_wrong_is_one_line_that_names_it(
    states_path: str, own: None, name: str, says: str
) -> None:
    with pytest.raises(InvalidPolicy, match=says) as refused:
        act_once(PolicyConfig(policy=f"own:{name}"), states_path, 0)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["three", "two"])
def test_what_is_no_policy_is_refused_before_it_acts(own: None, name: str) -> None:
    with pytest.raises(InvalidPolicy, match="must be a function of"):
        make_policy(PolicyConfig(policy=f"own:{name}"))


@pytest.mark.thorough
def test_a_function_is_found_in_the_folder_where_the_command_is_typed(
    states_path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "left_alone.py").write_text(
        "def act(observation, info, rng):\n    return [0, 0, 0, 0, 0, 0]\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    words = "--task unknot --nx 1 --policy left_alone:act --horizon 2 --episodes 9 --workers 2"
    with pytest.raises(SystemExit) as left:
        main(
            ["evaluate", *words.split(), "--states", states_path, "--quiet", "--out", "result.json"]
        )
    assert left.value.code == 0
    assert json.loads((tmp_path / "result.json").read_text())["episodes"] == 9


def test_a_function_sees_the_same_in_collect_as_in_evaluate(
    states_path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sees_state.py").write_text(
        "def act(observation):\n    assert observation.shape == (600,)\n    return [0] * 6\n"
    )
    monkeypatch.chdir(tmp_path)
    words = "--task unknot --nx 1 --policy sees_state:act --horizon 2 --episodes 1 --workers 1"
    words += f" --states {states_path} --quiet --image-size 16"
    for command in ("evaluate --split train", "collect --out there --id a/b-v0"):
        with pytest.raises(SystemExit) as left:
            main([*command.split(), *words.split()])
        assert left.value.code == 0
    assert EpisodeReader(tmp_path / "there" / "a" / "b-v0").stored == "both"


@pytest.mark.parametrize(
    ("policy", "says"),
    [
        ("genius", "use random"),
        ("no_such_module:act", "no_such_module"),
        ("nowhere.onnx", "no policy file"),
        ("knotgym.topology.gauss:absent", "absent"),
    ],
)
def test_a_policy_that_is_not_there_is_refused_in_one_line(policy: str, says: str) -> None:
    with pytest.raises(InvalidPolicy, match=says) as refused:
        make_policy(PolicyConfig(policy=policy))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "settings",
    [{"noise": 1.5}, {"noise": float("nan")}, {"shares": (1.0,)}, {"shares": (0.0, 0.0, 0.0, 0.0)}],
)
def test_settings_that_make_no_sense_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(KnotgymError, match="noise|shares"):
        PolicyConfig(**settings)


def test_a_registered_policy_is_made_by_its_name(
    states_path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policies, "_constructors", dict(policies._constructors))
    register_policy("restless", lambda config: RandomPolicy())
    config = PolicyConfig(policy="restless")
    assert config.short == "restless"
    expected = act_once(PolicyConfig(policy="random"), states_path, 0)
    assert np.array_equal(act_once(config, states_path, 0), expected)
    with pytest.raises(InvalidPolicy, match="mixed, restless, .*module:name"):
        PolicyConfig(policy="genius")


@pytest.mark.parametrize("name", ["expert", "", "module:function", "policy.zip"])
def test_a_name_that_is_taken_or_reads_as_a_place_is_not_registered(name: str) -> None:
    with pytest.raises(InvalidPolicy):
        register_policy(name, lambda config: RandomPolicy())


def test_digests_are_of_a_module_and_of_what_it_imports_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "digested" / "nets").mkdir(parents=True)
    for name, source in {
        "digested/__init__.py": "",
        "digested/policy.py": "import numpy\nfrom . import nets\nact = lambda seen: [0] * 6\n",
        "digested/nets/__init__.py": "def load():\n    from ..weights import VALUES\n",
        "digested/weights.py": "import aside.deep",
        "aside.py": "",
        "unused.py": "",
    }.items():
        (tmp_path / name).write_text(source)
    found = policy_digests(PolicyConfig(policy="digested.policy:act"))
    used = ("__init__", "policy", "nets/__init__", "weights")
    names = ["aside.py", *(f"digested/{name}.py" for name in used)]
    assert found == {name: sha256(tmp_path / name) for name in names}


def test_digests_are_of_weights_transcripts_and_the_planner_s_table(tmp_path: Path) -> None:
    (tmp_path / "model.pt").write_bytes(b"weights")
    (tmp_path / "transcripts.jsonl").write_bytes(b"{}")
    model, prompted = tmp_path / "model.pt", tmp_path / "transcripts.jsonl"
    asked = {str(model): ["model.pt"], f"prompt:{prompted}": ["transcripts"], "random": []}
    tables = ["passes-by-code.h5", "passes.h5", "transitions.h5"]
    asked |= {name: tables for name in ("expert", "noisy", "mixed")}
    asked |= {"planner": ["transitions.h5"]}
    for name, files in asked.items():
        assert list(policy_digests(PolicyConfig(policy=name))) == files
    assert policy_digests(PolicyConfig(policy=str(model))) == {"model.pt": sha256(model)}
    model.unlink()
    with pytest.raises(InvalidPolicy, match="model.pt"):
        policy_digests(PolicyConfig(policy=str(model)))
