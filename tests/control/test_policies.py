"""The contract that every policy meets, the registry, and user code as a policy."""

import dataclasses
import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.common import InvalidPolicy, Stream, Table
from knotgym.control import policies
from knotgym.control.own_policies import own_policy
from knotgym.control.policies import PolicyFamily, make_policy, register_policy
from knotgym.control.policy_config import MIXED, PolicyConfig, PullPlannerConfig
from knotgym.control.recorded_policy import replay
from knotgym.control.sampler import Pulls, SimplePolicy, rollouts
from knotgym.datasets import PULLS, Episodes
from knotgym.envs import TaskConfig
from knotgym.states import States
from knotgym.topology import CodeArrays, label

TASK = TaskConfig(task="tie", nx=2, engine="chain", observation="state", horizon=12)
ENDLESS = dataclasses.replace(TASK, endless=True)
QUICK = PullPlannerConfig(budget=80, batch_size=2)
RANDOM = make_policy(PolicyConfig())
SEEDS = [Stream.EPISODE.derived_seed(0, number) for number in range(20)]


class Counter:
    """Pulls a little harder at every step of an episode: a policy with a memory."""

    def reset(self, generator: np.random.Generator) -> None:
        self.pulls, self.side = 0, generator.uniform(-1, 1)

    def act(self, observation: NDArray[np.float32]) -> list[float]:
        self.pulls += 1
        return [0, 0, 0, self.pulls / 20, float(observation.shape == (600,)), self.side]


def wrong(answer: Any) -> SimplePolicy:
    """A policy whose player returns something else than pulls, or raises."""

    def make(batch: Any) -> Any:
        player: Any = RANDOM.player(batch)
        player.act = lambda ids: answer(player, ids)
        return player

    return SimplePolicy("wrong", make)


def _raise(player: Any, ids: Any) -> None:
    raise RuntimeError("out of memory")


def _pull_of(observation: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.sin(1000 * observation[:6])


def sharing(batch: Any) -> Any:
    """A player that returns the same arrays always, and changes those that it gets."""
    player: Any = RANDOM.player(batch)
    act, begin, kept = player.act, player.begin, np.zeros((batch.count, 3), np.float32)

    def shared(ids: Any) -> Pulls:
        own, pulls = ids.copy(), act(ids.copy())
        forces = kept[: len(own)]
        forces[:] = pulls.forces
        ids[:] = -5
        return Pulls(own, pulls.beads, forces)

    def begun(ids: Any, rngs: Any) -> None:
        begin(ids.copy(), rngs)
        ids[:], rngs[:] = -5, []

    player.act, player.begin = shared, begun
    return player


def giving(action: Any) -> Any:
    """A function that returns always the same."""

    def act(observation: object) -> Any:
        return action

    return staticmethod(act)


class Own:
    """A module of the user's."""

    # what shares what it returns, and changes or keeps what it is given

    kept = tuple[NDArray[np.float32], ...]()

    @staticmethod
    def mutates(observation: NDArray[np.float32], info: dict[str, Any], rng: Any) -> Any:
        action = _pull_of(observation)
        observation[:] = 0
        info["force"][:] = 9
        info.clear()
        return action

    @classmethod
    def keeps(cls, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        for one in cls.kept:
            one[:] = 9
        action = _pull_of(observation)
        cls.kept = (*cls.kept[-8:], observation, action)
        return action

    @staticmethod
    def aliases(observation: NDArray[np.float32]) -> NDArray[np.float32]:
        observation[:6] = _pull_of(observation)
        return observation[:6]

    shares = SimplePolicy("shares", sharing)

    # what returns something else than pulls

    none = wrong(lambda player, ids: None)
    others = wrong(lambda p, ids: Pulls(ids + 9, ids, np.zeros((len(ids), 3), np.float32)))
    many = wrong(lambda p, ids: Pulls(ids, ids, np.zeros((len(ids), 4), np.float32)))
    strong = wrong(lambda p, ids: Pulls(ids, ids, np.full((len(ids), 3), 2, np.float32)))
    raising = wrong(_raise)
    far, imaginary = giving([0.0] * 5 + [7.0]), giving(np.zeros(6, np.complex64))

    @staticmethod
    def two(observation: object, info: object) -> list[float]:
        return [0.0] * 6

    @staticmethod
    def faulty(observation: object) -> list[float]:
        raise KeyError("no such weight")

    @staticmethod
    def leaving(observation: object) -> list[float]:
        sys.exit()

    # what acts

    counter, made = Counter, Counter()
    policy = own_policy(lambda seen: [0.0] * 6, "still")
    plain, brief = staticmethod(_pull_of), giving([0, 0, 0, 0.5, 0, 0])

    @staticmethod
    def informed(observation: object, info: dict[str, object], rng: Any) -> list[float]:
        return [0, 0, 0, float("gauss_code" in info), 0, rng.uniform(-1, 1)]


@pytest.fixture(autouse=True)
def own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "own", Own)


def played(name: str, seeds: list[int], lanes: int, task: TaskConfig = TASK) -> Episodes:
    """Play episodes of a policy that is made for them."""
    policy = make_policy(PolicyConfig(policy=name, planner=QUICK))
    return rollouts(policy, task, seeds, lanes=lanes)


NAMES = "random constant scripted expert noisy mixed own:informed own:counter".split()
TASKS = {
    **{name: TASK for name in NAMES},
    "play": ENDLESS,
    "planner": dataclasses.replace(TASK, horizon=6),
}


@pytest.mark.parametrize("name", TASKS)
def test_an_episode_depends_on_its_own_seed_alone(name: str) -> None:
    many = played(name, SEEDS, 256, TASKS[name])
    few = played(name, SEEDS[::-1], 3, TASKS[name]).select(range(19, -1, -1))
    assert many.differences(few) == []
    assert many.select([7]).differences(played(name, SEEDS[7:8], 1, TASKS[name])) == []
    assert (many.episodes["length"] <= TASKS[name].horizon).all()


@pytest.mark.parametrize("name", ["mutates", "keeps", "aliases", "shares"])
def test_arrays_that_user_code_shares_or_changes_change_no_episode(name: str) -> None:
    seeds = [Stream.EPISODE.derived_seed(1, number) for number in range(64)]
    many = played(f"own:{name}", seeds, 64)
    plain = played("own:plain" if name != "shares" else "random", seeds, 64)
    assert np.array_equal(many.steps["force"], plain.steps["force"])
    for lanes, count in ((1, 4), (2, 8), (7, 32)):
        few = played(f"own:{name}", seeds[:count], lanes)
        assert many.select(range(count)).differences(few) == []


def test_varied_is_noisy_without_noise() -> None:
    task = TaskConfig(task="tie", nx=1, engine="chain", observation="state", horizon=12)
    both = PolicyConfig(policy="noisy", noise=0.0), PolicyConfig(policy="varied", noise=0.5)
    made = [rollouts(make_policy(one), task, [0, 1, 2, 3]) for one in both]
    assert made[0].digests() == made[1].digests()
    assert set(made[1].episodes["policy"].tolist()) == {"varied"}


@pytest.mark.parametrize("name", ["random", "scripted", "noisy", "own:informed"])
def test_another_attempt_draws_other_pulls_from_the_same_starts(name: str) -> None:
    policy = make_policy(PolicyConfig(policy=name))
    one, two = (rollouts(policy, TASK, SEEDS[:4], attempt=k) for k in (0, 1))
    assert np.array_equal(one.episodes["start_qpos"], two.episodes["start_qpos"])
    assert not np.array_equal(one.steps["force"][0], two.steps["force"][0])


@pytest.mark.parametrize("name", ["random", "expert", "mixed"])
def test_repeating_the_pulls_gives_the_same_bits(name: str) -> None:
    made = played(name, SEEDS, 16)
    again = replay(made.recording(), TASK)
    assert made.differences(again) == []


def test_kept_columns_are_those_asked_for() -> None:
    assert set(rollouts(RANDOM, TASK, SEEDS[:2], keep=PULLS).steps) == {"bead", "force"}
    outcomes = rollouts(RANDOM, TASK, SEEDS[:2], keep=None)
    assert outcomes.episodes.rows == 2 and not len(outcomes.steps)
    assert rollouts(RANDOM, TASK, []).episodes.rows == 0


def test_codes_with_more_crossings_than_there_was_room_for_are_kept_whole() -> None:
    turn = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    radius = 2 + np.cos(9 * turn)  # nine times round one way, five the other: 36 crossings
    curve = [radius * np.cos(5 * turn), radius * np.sin(5 * turn), 3 * np.cos(turn + 0.2)]
    laid = States.from_points([np.stack(curve, axis=1)]).qpos
    begun = rollouts(RANDOM, TASK, SEEDS[:2]).episodes
    starts = Table(begun.schema, {**begun, "start_qpos": np.stack([begun["start_qpos"][0], *laid])})
    made = rollouts(RANDOM, TASK, starts, lanes=1)
    shown = CodeArrays(made.steps["visits"], made.steps["signs"]).texts()
    assert [label(points).chiral for points in made.steps["observation"]] == shown.tolist()
    assert made.steps["crossings"][made.offsets[:-1]].tolist() == [0, 36]


def test_advice_is_stored_and_not_followed() -> None:
    expert = make_policy(PolicyConfig(policy="expert"))
    made = rollouts(RANDOM, TASK, SEEDS[:4], adviser=expert)
    plain = rollouts(RANDOM, TASK, SEEDS[:4])
    assert plain.differences(made) == [] and "expert_action" not in plain.steps
    advised = made.steps["expert_action"][made.offsets[:-1]]
    followed = rollouts(expert, TASK, SEEDS[:4])
    assert np.array_equal(advised, followed.steps["action"][followed.offsets[:-1]])
    assert (made.episodes["planner_steps"] > 0).all()
    assert not made.steps["expert_action"][made.last()].any()


def test_a_mixed_policy_with_one_share_is_that_policy() -> None:
    for name in MIXED:
        shares = tuple(float(other == name) for other in MIXED)
        policy = make_policy(PolicyConfig(policy="mixed", shares=shares))
        assert set(rollouts(policy, TASK, SEEDS[:2]).episodes["policy"]) == {name}


# user code


@pytest.mark.parametrize(
    ("name", "pull"),
    [("informed", 1), ("brief", 0.5), ("counter", 0.05), ("made", 0.05), ("policy", 0)],
)
def test_functions_objects_and_policies_of_the_user_act(name: str, pull: float) -> None:
    made = played(f"own:{name}", SEEDS[:2], 2)
    assert (made.steps["force"][made.offsets[:-1], 0] == np.float32(pull)).all()


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("far", "must give 6 finite numbers in .* got .*7.0"),
        ("imaginary", "must give 6 finite numbers"),
        ("faulty", "own:faulty raised KeyError: 'no such weight' .test_policies.py, line"),
        ("leaving", "own:leaving raised SystemExit.* .test_policies.py, line"),
        ("two", "must be a function of"),
        ("absent", "absent"),
        *((name, "must return Pulls") for name in ("none", "others", "many", "strong")),
        ("raising", "own:raising raised RuntimeError: out of memory .test_policies.py, line"),
    ],
)
def test_what_user_code_does_wrong_is_one_line_that_names_it(name: str, says: str) -> None:
    with pytest.raises(InvalidPolicy, match=says) as refused:
        played(f"own:{name}", SEEDS[:2], 2)
    assert "\n" not in str(refused.value) and "own:" in str(refused.value)


@pytest.mark.parametrize("module", ["left_alone", "in_a_folder.of.mine", "packed.mine"])
def test_a_module_is_found_with_what_it_imports_and_opens(
    module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two files of one name are two; so is a helper that is imported when it acts."""
    source = tmp_path.joinpath(*module.split(".")).with_suffix(".py")
    source.parent.mkdir(parents=True, exist_ok=True)
    code = (
        "import helper_of_mine, json\nFILES = ['seed0/w.txt', 'seed1/w.txt']\n"
        "class Made:\n    def __init__(self): open('opened').close(); open('log', 'w').close()\n"
        "    def reset(self): from pack_of_mine import part\n"
        "    def act(self, seen): return [0] * 6\n"
    )
    files = {source: code, tmp_path / "helper_of_mine.py": "import second_helper\n"}
    files |= {tmp_path / name: "" for name in ("second_helper.py", "no_helper.py", "opened")}
    files |= {tmp_path / f"pack_of_mine/{name}.py": "" for name in ("__init__", "part")}
    files |= {tmp_path / f"seed{k}/w.txt": str(k) for k in range(2)}
    files |= {tmp_path / "packed/__init__.py": ""} if module == "packed.mine" else {}
    for file, text in files.items():
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    monkeypatch.chdir(tmp_path)
    for name in ("helper_of_mine", "second_helper", "pack_of_mine", "pack_of_mine.part"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    path = list(sys.path)
    found = PolicyConfig(policy=f"{module}:Made").files()
    assert sys.path == path
    names = {"w.txt", "w.txt (2)"} | {
        file.relative_to(tmp_path).as_posix()
        for file in files
        if file.name not in ("w.txt", "no_helper.py")
    }
    assert found.keys() == names
    assert [found[name].read_text() for name in ("w.txt", "w.txt (2)")] == ["0", "1"]


def test_a_module_that_exits_is_no_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "leaves_at_once.py").write_text("import sys\nsys.exit()\n")
    monkeypatch.chdir(tmp_path)
    for call in (make_policy, PolicyConfig.files):
        with pytest.raises(InvalidPolicy, match="SystemExit.*leaves_at_once.py, line 2"):
            call(PolicyConfig(policy="leaves_at_once:act"))


# the registry


def test_a_registered_policy_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policies, "_table", dict(policies._table))
    weights = tmp_path / "weights"
    weights.write_bytes(b"weights")
    register_policy(
        PolicyFamily(
            form="restless", make=lambda config: RANDOM, files=lambda n: {"weights": weights}
        )
    )
    assert make_policy(PolicyConfig(policy="restless")) is RANDOM
    assert PolicyConfig(policy="restless").files() == {"weights": weights}
    weights.unlink()
    with pytest.raises(InvalidPolicy, match="weights"):
        PolicyConfig(policy="restless").files()
    register_policy(PolicyFamily(form="leaving", make=lambda config: sys.exit(3)))
    with pytest.raises(InvalidPolicy, match="policy leaving raised SystemExit: 3 .test_policies"):
        make_policy(PolicyConfig(policy="leaving"))


@pytest.mark.parametrize(("name", "tables"), [("expert", 2), ("planner", 2), ("random", 0)])
def test_digests_are_of_the_planners_tables(name: str, tables: int) -> None:
    assert len(PolicyConfig(policy=name).files()) == tables


still = PolicyFamily(
    form="still:WORD",
    matches=lambda name: name.startswith("still:"),
    make=lambda config: RANDOM,
    files=lambda name: {"this": Path(__file__)},
    card=lambda name: {"word": name.partition(":")[2]},
)


@pytest.fixture
def provided(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[EntryPoint]]:
    """The installed entry points, empty at first."""
    found: list[EntryPoint] = []
    monkeypatch.setattr(policies, "entry_points", lambda group: found)
    policies._entry_point_families.cache_clear()
    monkeypatch.setitem(sys.modules, "still_policies", sys.modules[__name__])
    yield found
    policies._entry_point_families.cache_clear()


def test_another_package_s_family_makes_policies(provided: list[EntryPoint]) -> None:
    provided.append(EntryPoint("still", "still_policies:still", policies.GROUP))
    config = PolicyConfig(policy="still:now")
    assert make_policy(config) is RANDOM
    assert list(config.files()) == ["this"]
    assert PolicyConfig(policy="still:now").card() == {"word": "now"}
    assert PolicyConfig(policy="random").card() is None


def test_a_family_that_cannot_be_loaded_is_named_in_one_line(provided: list[EntryPoint]) -> None:
    provided.append(EntryPoint("broken", "no_such_module:family", policies.GROUP))
    with pytest.raises(InvalidPolicy, match="broken = no_such_module:family") as refused:
        make_policy(PolicyConfig(policy="pretrained"))
    assert "\n" not in str(refused.value)
