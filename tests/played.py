"""Rounds of play, followed to their end, and what an archive knows by number of crossings."""

from knotgym.generate.states.archive import Archive
from knotgym.generate.states.search import SearchConfig, search_round
from knotgym.runs.pools import Pool
from knotgym.topology.diagrams import chiralities
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import mirror_images


def advance(archive: Archive, config: SearchConfig, pool: Pool) -> None:
    for batch in search_round(archive, config):
        for _ in batch.follow(pool):
            pass


def known_codes(archive: Archive, nx: int) -> list[GaussCode]:
    """The codes without chirality that an archive has elites of, sorted by visits."""
    niches = [niche for niche in archive.niches if niche.nx == nx]
    known = {image.plain for niche in niches for image in mirror_images(niche)}
    return sorted(known, key=lambda code: code.visits)


def known_chiralities(archive: Archive, code: GaussCode) -> list[GaussCode]:
    chiral = [GaussCode(code.visits, letters) for letters in chiralities(code)]
    return [code for code in chiral if mirror_images(code)[0] in archive.niches]
