"""`knotgym doctor` compares digests of a fixed list with those recorded, and says what differs."""

import pytest
from pytest_types import Capture, Patch

from knotgym.cli import doctor_command

from ..small_job import knotgym


@pytest.mark.thorough
def test_every_digest_of_the_list_is_as_recorded() -> None:
    assert dict(doctor_command._measured()) == doctor_command.EXPECTED


@pytest.mark.parametrize("wrong", [None, "picture"])
def test_differences_are_one_line(monkeypatch: Patch, capsys: Capture, wrong: str | None) -> None:
    found = {**doctor_command.EXPECTED, **({wrong: "0" * 12} if wrong else {})}
    monkeypatch.setattr(doctor_command, "_measured", lambda: iter(found.items()))
    assert knotgym("doctor") == (1 if wrong else 0)
    out, err = capsys.readouterr()
    assert out.count("ok ") == (11 if wrong else 12) and "numba" in out
    assert ("1 of 12 differ: picture" in err) == bool(wrong)
