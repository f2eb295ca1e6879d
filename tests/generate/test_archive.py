"""The archive keeps the best of each class, and comes back from its file as it was."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from knotgym.common.errors import InvalidFile, InvalidInput
from knotgym.control.action_sequence import ActionSequence
from knotgym.generate.states.archive import Archive, ArchiveConfig, Elite
from knotgym.topology.diagrams import planar_codes
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import mirror_images

from ..played import known_chiralities, known_codes

CONFIG = ArchiveConfig()
KINK = GaussCode.parse("1+a,1-a")


def elite(
    length: int,
    objective: float,
    base_shift: int = 0,
    code: GaussCode = KINK,
    reverse: bool = False,
) -> Elite:
    return Elite(
        code,
        base_shift,
        reverse,
        ActionSequence(np.zeros(length, dtype=np.int16), np.zeros((length, 3), dtype=np.float32)),
        np.zeros(5),
        objective,
    )


def kept(archive: Archive) -> list[tuple[int, float]]:
    return [
        (len(elite.sequence), elite.objective) for elite in archive.niches[mirror_images(KINK)[0]]
    ]


@pytest.fixture
def saved(searched: Archive, tmp_path: Path) -> Path:
    searched.save(tmp_path / "archive.h5")
    return tmp_path / "archive.h5"


def test_only_the_first_of_a_class_is_new() -> None:
    archive = Archive()
    assert [archive.offer(elite(3, 1.0, code=code), CONFIG) for code in mirror_images(KINK)] == [
        True,
        False,
        False,
        False,
    ]


def test_the_shortest_sequences_are_kept_and_the_best_looking_states() -> None:
    archive = Archive()
    for length in range(1, 10):
        archive.offer(elite(length, 10.0 - length), CONFIG)
    assert CONFIG.kept == 2
    assert kept(archive) == [(1, 9.0), (2, 8.0), (9, 1.0), (8, 2.0)]


def test_the_order_of_offers_does_not_matter_to_what_is_kept() -> None:
    offers = [
        elite(length, objective)
        for length, objective in ((3, 5.0), (1, 9.0), (7, 0.5), (2, 8.0), (9, 0.1), (5, 5.0))
    ]
    one, other = Archive(), Archive()
    for offer in offers:
        one.offer(offer, CONFIG)
    for offer in offers[::-1]:
        other.offer(offer, CONFIG)
    assert kept(one) == kept(other)


def test_a_state_that_is_short_and_good_is_kept_once() -> None:
    archive = Archive()
    for length in (1, 2, 3, 4):
        archive.offer(elite(length, float(length)), CONFIG)
    assert kept(archive) == [(1, 1.0), (2, 2.0)]


def test_the_walk_along_the_beads_replaces_those_from_elsewhere_or_backwards() -> None:
    archive = Archive()
    for offer in (
        elite(1, 0.1, base_shift=14),
        elite(2, 0.1, reverse=True),
        elite(9, 3.0),
        elite(2, 0.1, base_shift=29),
    ):
        archive.offer(offer, CONFIG)
    assert kept(archive) == [(9, 3.0)]


def test_a_class_found_makes_all_its_codes_known() -> None:
    archive = Archive()
    archive.offer(elite(1, 1.0), CONFIG)
    assert set(known_codes(archive, 1)) == set(planar_codes(1)) and known_codes(archive, 2) == []


def test_an_empty_archive_leads_nowhere() -> None:
    assert Archive().leading_to(KINK) == [] and not known_chiralities(Archive(), KINK.plain)


def test_every_code_known_has_a_chirality_and_elites(searched: Archive) -> None:
    codes = [code for nx in range(4) for code in known_codes(searched, nx)]
    assert len(codes) > 3
    for code in codes:
        assert known_chiralities(searched, code) and all(
            handed.visits == code.visits and searched.leading_to(handed)
            for handed in known_chiralities(searched, code)
        )


def test_what_leads_to_a_code_has_it_among_its_mirror_images(searched: Archive) -> None:
    handed = [
        chiral for code in known_codes(searched, 2) for chiral in known_chiralities(searched, code)
    ]
    assert handed
    for chiral in handed:
        leading = searched.leading_to(chiral)
        assert leading and all(chiral in mirror_images(elite.code) for elite in leading)


def test_the_archive_comes_back_as_saved(searched: Archive, saved: Path) -> None:
    read = Archive.load(saved)
    assert (
        list(read.niches) == list(searched.niches)
        and read.visits == searched.visits
        and read.growth == searched.growth
    )
    for ours, theirs in zip(searched.niches.values(), read.niches.values(), strict=True):
        for saved_elite, elite in zip(ours, theirs, strict=True):
            for name in ("code", "base_shift", "reverse", "objective", "state"):
                assert np.array_equal(getattr(saved_elite, name), getattr(elite, name))
            for name in ("beads", "forces"):
                before, after = getattr(saved_elite.sequence, name), getattr(elite.sequence, name)
                assert np.array_equal(before, after) and before.dtype == after.dtype


def test_saving_again_gives_the_same_bytes(saved: Path, tmp_path: Path) -> None:
    Archive.load(saved).save(tmp_path / "again.h5")
    assert (tmp_path / "again.h5").read_bytes() == saved.read_bytes()


def test_an_archive_of_any_growth_can_be_saved(searched: Archive, tmp_path: Path) -> None:
    Archive(
        searched.niches,
        searched.visits,
        searched.growth * 2000,
        searched.settings,
        searched.transitions,
    ).save(tmp_path / "long.h5")
    assert len(Archive.load(tmp_path / "long.h5").growth) == 2000 * len(searched.growth)


def test_a_missing_archive_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no archive at .*absent\.h5"):
        Archive.load(tmp_path / "absent.h5")


def test_a_foreign_file_is_refused_in_one_line(tmp_path: Path, states_path: str) -> None:
    (tmp_path / "text.h5").write_text("not HDF5")
    for path in (tmp_path / "text.h5", Path(states_path)):
        with pytest.raises(InvalidFile, match=path.name) as caught:
            Archive.load(path)
        assert "\n" not in str(caught.value)


def test_another_format_version_is_refused(saved: Path) -> None:
    with h5py.File(saved, "a") as file:
        file.attrs["format_version"] = 99
    with pytest.raises(
        InvalidFile,
        match="version 99; this version reads 'knotgym-archive' version 1",
    ):
        Archive.load(saved)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.7, 0.999])
def test_a_truncated_archive_is_refused_in_one_line(saved: Path, share: float) -> None:
    raw = saved.read_bytes()
    saved.write_bytes(raw[: int(share * len(raw))])
    with pytest.raises(InvalidFile, match="isn't a whole archive") as caught:
        Archive.load(saved)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "name",
    [
        "code",
        "base_shift",
        "reverse",
        "objective",
        "length",
        "beads",
        "forces",
        "state",
        "growth",
        "visits",
        "settings",
    ],
)
def test_a_column_that_is_missing_or_nonsense_is_refused(saved: Path, name: str) -> None:
    for nonsense in (None, 3.5, np.arange(3), "{"):
        with h5py.File(saved, "a") as file:
            if name in file:
                del file[name]
            if nonsense is not None:
                file[name] = nonsense
        with pytest.raises(InvalidFile):
            Archive.load(saved)


def test_elites_are_told_apart_by_what_they_are_not_by_how_they_look() -> None:
    one = elite(2, 1.0)
    assert one != replace(one) and one == one


def test_as_many_elites_are_kept_as_asked_for() -> None:
    archive = Archive()
    for length in range(1, 10):
        archive.offer(elite(length, 10.0 - length), ArchiveConfig(kept=1))
    assert kept(archive) == [(1, 9.0), (9, 1.0)]


@pytest.mark.parametrize("settings", [{"kept": 0}, {"kept": 1.5}, {"fair": 0.0}])
def test_settings_that_make_no_sense_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(InvalidInput):
        ArchiveConfig(**settings)
