"""Answers are parsed strictly, and every fault has a name."""

import pytest

from knotgym.prompting.answers import read_actions, read_code

ONE = "[0.1, -0.2, 0, 1, 0, -1]"


def test_an_answer_after_thoughts_is_read() -> None:
    text = f"First [1, 2] I think.\n<answer>\n{ONE}\n{ONE},\n</answer>\n"
    assert read_actions(text, 2) == ([[0.1, -0.2, 0, 1, 0, -1]] * 2, "")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "no block"),
        (f"<answer>{ONE}", "no block"),
        (f"<answer>{ONE}</answer> or <answer>{ONE}</answer>", "several blocks"),
        ("<answer>pull it</answer>", "malformed"),
        ("<answer>[0.1, 1_0, 0, 1, 0, 0]</answer>", "malformed"),
        (f"<answer>[{', '.join(['0'] * 11)}]</answer>", "not six numbers"),
        ("<answer>[0, 0, NaN, 1, 0, 0]</answer>", "not finite"),
        ("<answer>[0, 0, 0, 1.0001, 0, 0]</answer>", "out of range"),
        ("<answer></answer>", "number of actions"),
        (f"<answer>{ONE}{ONE}</answer>", "number of actions"),
    ],
)
def test_a_wrong_answer_has_no_action_and_a_fault(text: str, fault: str) -> None:
    assert read_actions(text, 1) == ([], fault)


MARKS = "```json\n{}\n```\n", "$${}$$", "**`{}`**", "\u201c{}\u201d", "'{}'", "\n{}\n"


@pytest.mark.parametrize("mark", MARKS)
def test_marks_around_an_answer_and_other_signs_for_minus_do_not_count(mark: str) -> None:
    actions, code = (mark.format(one).replace("-", "\u2212") for one in (ONE, "[1+,1-]"))
    assert read_actions(f"<answer>{actions}</answer>", 1) == ([[0.1, -0.2, 0, 1, 0, -1]], "")
    assert str(read_code(f"<answer>{code}</answer>")[0]) == "1+,1-"
    assert str(read_code(f"<answer>{code[::-1]}</answer>")[0]) == "None"


@pytest.mark.parametrize(
    ("text", "code"),
    [("1+,1-", "1+,1-"), (" [1-, 2+, 2-, 1+] ", "1-,2+,2-,1+"), ("", ""), ("[]", "")],
)
def test_a_code_is_read_with_brackets_or_without(text: str, code: str) -> None:
    assert str(read_code(f"so <answer>{text}</answer>")[0]) == code


@pytest.mark.parametrize("text", ["1+,1+", "2+,2-", "none", "1+;1-", "9" * 5000 + "+"])
def test_an_invalid_code_is_malformed(text: str) -> None:
    assert read_code(f"<answer>{text}</answer>") == (None, "malformed")
