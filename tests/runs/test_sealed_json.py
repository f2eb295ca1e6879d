"""What a run saves comes back as it was, or not at all."""

from pathlib import Path

import pytest

from knotgym.common.errors import InvalidFile
from knotgym.runs.sealed_json import read_sealed, write_sealed

SAID = {"cycle": 3, "growth": [{"steps": 0.1}], "tried": {10: 1, 2: 3}, "of": (1, 2), "name": "é"}


def test_what_was_written_comes_back_as_json_has_it(tmp_path: Path) -> None:
    write_sealed(tmp_path / "a.json", SAID)
    assert read_sealed(tmp_path / "a.json") == {**SAID, "tried": {"10": 1, "2": 3}, "of": [1, 2]}


@pytest.mark.parametrize("old, new", [("3", "2"), ('"cycle"', '"cycles"'), ('"seal"', '"sea"')])
def test_a_changed_number_name_or_seal_is_told(old: str, new: str, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_sealed(path, SAID)
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InvalidFile, match=r"a\.json isn't what was written"):
        read_sealed(path)
