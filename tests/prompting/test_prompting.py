"""Episodes and pictures with a scripted model: what is asked, what is kept, what is replayed."""

from __future__ import annotations

import json
from base64 import b64encode
from pathlib import Path
from typing import Any

import pytest

from knotgym.common import Failed, InvalidFile, InvalidInput, Occupied
from knotgym.datasets import decode, encode
from knotgym.envs import TaskConfig
from knotgym.prompting.chat import ChatConfig
from knotgym.prompting.prompt_run import run_prompts
from knotgym.prompting.prompts import FIRST, PromptConfig
from knotgym.prompting.transcripts import _read_transcripts, reading_scores, show_transcripts
from knotgym.runs import RunOptions

from ..small_job import staging_of
from .chat_server import Answer, ChatServer, always, completion, hashes, kinds

KEY = "sk-test/+" + "51ec2e7" * 4
PULL = "I pull. <answer>[0.1, 0, 0, 1, 0, 0]</answer>"
NAN = "<answer>[0.1, 0, 0, nan, 0, 0]</answer>"
QUIET = RunOptions(quiet=True)
RESUME = RunOptions(quiet=True, resume=True)


@pytest.fixture(autouse=True)
def key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", KEY)


def config(url: str, mode: str = "stateless", **more: Any) -> PromptConfig:
    chat = ChatConfig(model="m", base_url=url, timeout=5.0, attempts=2)
    task = TaskConfig(task="unknot", nx=2, horizon=4, image_size=16, engine="chain")
    usual = {"mode": mode, "chat": chat, "task": task, "episodes": 1, "side_by_side": 1}
    return PromptConfig(**{**usual, **more})


def played(server: ChatServer, out: Path, mode: str = "stateless", **more: Any) -> Any:
    """Run prompts against a server; return the transcripts and the totals."""
    with server.serving():
        run_prompts(config(server.url, mode, **more), out, QUIET)
    result = json.loads((out / "result.json").read_text())
    return _read_transcripts(out / "transcripts.jsonl"), result


def test_a_prompt_has_all_parts_in_their_order(tmp_path: Path) -> None:
    server = ChatServer(always(PULL))
    ((told,), _) = played(server, tmp_path / "run")
    (asks,) = {tuple(map(kinds, one["messages"])) for one in server.requests}
    assert asks == ("ttptttptpt",)
    texts = [part.get("text", "") for part in server.requests[0]["messages"][0]["content"]]
    beginnings = ("Task:", "This picture", "", "You succeed", "An action", "The goal:", "")
    assert all(text.startswith(word) for text, word in zip(texts, beginnings, strict=False))
    assert texts[7] == "The rope now:" and "<answer>" in texts[9]
    shown = [hashes(one["messages"][0]) for one in server.requests]
    assert [one[0] for one in shown] == [FIRST.sha256] * len(shown)
    assert [one[2] for one in shown] == [turn["picture"] for turn in told["turns"]]
    assert {one["picture"] for one in told["prompt"] if isinstance(one, dict)} == {*shown[0][:2]}
    assert len(shown) == len(told["actions"]) == len(told["gauss_code"]) - 1


def test_the_window_holds_the_last_turns_and_their_answers(tmp_path: Path) -> None:
    server = ChatServer(lambda number, body: PULL.replace("I pull.", f"Turn {number}."))
    ((told,), _) = played(server, tmp_path / "run", "stateful", window=2)
    asks = [[kinds(message) for message in one["messages"]] for one in server.requests]
    assert asks[:2] == [["ttptttptpt"], ["ttptttptpt", "a", "tpt"]]
    assert asks[2] == asks[3] == ["ttptttptpt", "a", "tpt", "a", "tpt"]
    last = server.requests[3]["messages"]
    said = [one["content"][:7] for one in last if one["role"] == "assistant"]
    assert said == ["Turn 1.", "Turn 2."]
    pictures = [hashes(one)[-1] for one in last if one["role"] == "user"]
    assert pictures == [turn["picture"] for turn in told["turns"][1:]]
    assert [turn["window"] for turn in told["turns"]] == [0, 1, 2, 2]


def test_open_mode_asks_once_and_then_leaves_the_rope_alone(tmp_path: Path) -> None:
    server = ChatServer(always("<answer>[0.1,0,0,1,0,0] [0,0.1,0,0,1,0]</answer>"))
    ((told,), _) = played(server, tmp_path / "run", "open", tell_centre=True)
    assert len(server.requests) == 1 and len(told["actions"]) == 4
    assert [any(action) for action in told["actions"]] == [True, True, False, False]
    assert "middle of this picture" in server.requests[0]["messages"][0]["content"][7]["text"]


def test_wrong_answers_are_counted_apart_and_leave_the_rope_alone(tmp_path: Path) -> None:
    answers = [NAN, "no", PULL, "<answer>[" + ", ".join(["0"] * 11) + "]</answer>"]
    server = ChatServer(lambda number, body: answers[number])
    ((told,), result) = played(server, tmp_path / "run")
    faults = [turn["fault"] for turn in told["turns"]]
    assert faults == ["not finite", "no block", "", "not six numbers"]
    assert [any(action) for action in told["actions"]] == [False, False, True, False]
    assert result["answers"]["valid"] == 1 and result["retries"] == {}


def test_truncation_reasoning_and_unknown_usage_are_in_the_transcript(tmp_path: Path) -> None:
    cut_off = completion({"content": PULL, "reasoning_content": "so"}, "length", usage=None)
    server = ChatServer(always(cut_off))
    ((told,), result) = played(server, tmp_path / "run", "open")
    (turn,) = told["turns"]
    assert (turn["finish"], turn["reasoning"], result["truncated"]) == ("length", "so", 1)
    assert told["prompt_tokens"] is result["prompt_tokens"] is None


def test_a_run_is_resumed_and_the_key_is_nowhere(tmp_path: Path) -> None:
    broken = [True]

    def answer(number: int, body: Any) -> Answer:
        if broken[0] and number >= 6:
            return (500, {}, f"the key {KEY} is bad")
        return f"\ud83d{PULL} {KEY}" if number % 3 else NAN

    server, out = ChatServer(answer), tmp_path / "run"
    with server.serving():
        settings: dict[str, Any] = {"episodes": 3, "seed": 5}
        own = config(server.url, **settings)
        with pytest.raises(Failed) as refused:
            run_prompts(own, out, QUIET)
        assert not out.exists()
        broken[0] = False
        with pytest.raises(Occupied, match="--resume continues it"):
            run_prompts(own, out, QUIET)
        with pytest.raises(InvalidInput, match="window"):
            run_prompts(config(server.url, window=3, **settings), out, RESUME)
        before = len(server.requests)
        patient = ChatConfig(model="m", base_url=server.url, timeout=9.0)
        run_prompts(config(server.url, chat=patient, **settings), out, RESUME)
        assert len(server.requests) == before + 6  # of three episodes of four actions
        run_prompts(own, out, RESUME)  # it is there
    result = json.loads((out / "result.json").read_text())
    told = _read_transcripts(out / "transcripts.jsonl")
    assert [one["number"] for one in told] == [0, 1, 2]
    assert result["answers"] == {"valid": 8, "not finite": 4} and result["episodes"] == 3
    assert (result["prompt_tokens"], result["completion_tokens"]) == (1200, 120)
    assert "\ufffd" in told[1]["turns"][0]["answer"]  # half a surrogate pair isn't UTF-8
    files = [path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()]
    everything = b"".join(files) + str(refused.value).encode()
    assert KEY.encode() not in everything and b"[key]" in everything
    assert not staging_of(out).exists()


FILTERED: Any = (400, {}, json.dumps({"error": {"message": "no", "code": "content_filter"}}))


def test_a_rejected_request_counts_as_a_refusal_and_the_run_goes_on(tmp_path: Path) -> None:
    server = ChatServer(lambda number, body: PULL if number % 4 else FILTERED)
    (told, result) = played(server, tmp_path / "run", episodes=2)
    assert result["answers"] == {"valid": 6, "refusal": 2}
    assert result["rejected"] == {"400 content_filter": 2}
    assert len(told[0]["actions"]) == 4 and told[0]["turns"][0]["rejected"].endswith(": no")
    facts, _ = show_transcripts(tmp_path / "run") or ({}, [])
    assert facts["rejected"] == {"400 content_filter": 2}


def test_a_server_that_rejects_every_request_ends_the_run_until_restarted(tmp_path: Path) -> None:
    mended = [False]

    def answer(number: int, body: Any) -> Answer:
        return PULL if mended[0] else FILTERED

    server, out = ChatServer(answer), tmp_path / "run"
    with server.serving():
        own = config(server.url, "open", episodes=24)
        for options in (QUIET, RESUME):
            with pytest.raises(InvalidInput, match="rejects all of 20 .* --restart"):
                run_prompts(own, out, options)
        assert len(server.requests) == 20
        mended[0] = True
        run_prompts(own, out, RunOptions(quiet=True, restart=True))
    assert json.loads((out / "result.json").read_text())["answers"] == {"valid": 24}


def test_side_by_side_gives_the_same_transcripts(tmp_path: Path) -> None:
    texts = []
    server = ChatServer(always(PULL))
    with server.serving():
        for count in (1, 3):
            out = tmp_path / str(count)
            run_prompts(config(server.url, "open", episodes=3, side_by_side=count), out, QUIET)
            texts.append((out / "transcripts.jsonl").read_text())
    assert texts[0] == texts[1]


def test_a_picture_s_code_is_asked_for_and_scored(tmp_path: Path) -> None:
    pictures = [encode(decode(FIRST.png)[: 16 + k, :16]) for k in range(3)]
    row = {"gauss_code": "1+,1-,2-,2+", "nx": 2, "grade": "easy"}
    rows = [{**row, "image": one, "accepted": not k} for k, one in enumerate(pictures)]
    answers = ["<answer>1+,1-,2-,2+</answer>", "<answer>1+,1-</answer>", "it is a loop"]

    def answer(number: int, body: Any) -> str:  # requests are sent side by side
        sent = json.dumps(body)
        held = [b64encode(one).decode() in sent for one in pictures]
        return answers[held.index(True)]

    server = ChatServer(answer)
    with server.serving():
        run_prompts(config(server.url, "read"), tmp_path / "run", QUIET, rows=rows)
        with pytest.raises(InvalidInput, match="source.pictures is"):
            run_prompts(config(server.url, "read"), tmp_path / "run", RESUME, rows=rows[:2])
    told = _read_transcripts(tmp_path / "run" / "transcripts.jsonl")
    asked = {hashes(one["messages"][0])[1] for one in server.requests}
    assert asked == {one["picture"] for one in told}
    assert [one["fault"] for one in told] == ["", "", "no block"]
    scores = reading_scores(told)
    assert [*scores] == ["all", "nx 2", "easy"]
    assert scores["all"] == pytest.approx({"pictures": 3, "exact": 1 / 3, "crossings": 1 / 3})
    facts, table = show_transcripts(tmp_path / "run") or ({}, [])
    assert facts["mode"] == "read" and ("easy", "3", "33.3 %", "33.3 %") in table


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "line 1 isn't JSON"),
        ("[]", "isn't a transcript"),
        ("{}", "format None"),
        ('{"format": "knotgym-transcript", "format_version": 9}', "version 9"),
        ('{"format": "knotgym-transcript", "format_version": 2}', "Field required"),
    ],
)
def test_a_line_that_is_no_transcript_is_refused(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "t.jsonl").write_text(text + "\n")
    with pytest.raises(InvalidFile, match=said):
        _read_transcripts(tmp_path / "t.jsonl")
