"""A folder that is a Minari root, its first level a repository to upload to Hugging Face.

    {out}/knotgym/README.md, CITATION.cff, gallery.png, namespace_metadata.json
    {out}/knotgym/tie-nx3/demonstrations-v0/data/       the datasets, byte for byte

With MINARI_DATASETS_PATH={out} `minari.load_dataset` reads them; uploaded to hf://USER, it
downloads them. All ids begin with one word, for Minari makes a repository of it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from knotgym.atomic_files import atomic_write, copy_file, require_no_links, require_output
from knotgym.configuration import read_json
from knotgym.datasets.cards.citation import TO_CITE, citation_file, plain
from knotgym.datasets.cards.state_card import table
from knotgym.datasets.episode_reader import episode_file
from knotgym.datasets.exports.forms import NothingToExport
from knotgym.datasets.gallery import write_episode_gallery
from knotgym.datasets.minari_dataset import dataset_files
from knotgym.datasets.states import leads_out

_ROWS = (
    ("`observations`", "pictures uint8, vertices float32 (600,) in metres, or both"),
    ("`actions`", "float32 (T, 6) in [-1, 1]: place / 2 m, force / 0.2 N"),
    ("`rewards`, `terminations`, `truncations`", "(T,)"),
    ("`infos/gauss_code`, `infos/goal_gauss_code`", "(T + 1,), of the state and of the goal"),
    ("`infos/points`", "float64 (T + 1, 100, 3), m: vertices at every state"),
    ("`infos/crossings`, `infos/is_success`", "(T + 1,)"),
    ("`infos/bead`, `infos/force`", "(T + 1,) and (T + 1, 3), N: the pull that led here"),
    ("`infos/applied_share`", "(T + 1,), of the force asked for; below 1 in an eased step"),
)


def to_minari(
    datasets: Sequence[Path], out: str | os.PathLike[str], *, overwrite: bool = False
) -> None:
    """Write the folder, whole or not at all.

    Raises:
        NothingToExport: one is no Minari dataset, or two have one id or no common first word.
        LinkedFile: a dataset's file is a link.
        Occupied: `out` exists, and `overwrite` isn't asked for.
    """
    require_output(out, folder=True, overwrite=overwrite)
    entries: dict[str, dict[str, Any]] = {}
    sources: dict[str, Path] = {}
    for dataset in datasets:
        data = episode_file(dataset).parent
        require_no_links(Path(dataset), dataset_files(data))
        try:
            said = read_json(data / "metadata.json")
            name, _ = str(said["dataset_id"]), (said["total_episodes"], said["total_steps"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise NothingToExport(
                f"{dataset} is no Minari dataset; knotgym dataset merge --id makes one of it"
            ) from error
        if name in sources:
            raise NothingToExport(f"two datasets have the id {name}: {sources[name]} and {data}")
        entries[name], sources[name] = said, data
    if out_of := [name for name in sources if leads_out(name)]:
        raise NothingToExport(f"the id {out_of[0]!r} of {sources[out_of[0]]} leads out of a folder")
    words = {name.partition("/")[0] for name in sources}
    if len(words) != 1 or any("/" not in name for name in sources):
        raise NothingToExport(
            "a repository holds ids that begin with one word, as knotgym/tie-nx2/expert-v0; these"
            f" are {', '.join(sources)}"
        )
    with atomic_write(out, overwrite=overwrite) as root:
        repository = root / words.pop()
        for name, data in sources.items():
            (root / name / "data").mkdir(parents=True)
            for file in dataset_files(data):
                copy_file(file, root / name / "data" / file.name)
        namespace = {"description": "Closed ropes in MuJoCo, goals that are Gauss codes."}
        listed = {**namespace, "datasets": sorted(sources), "namespaces": []}
        _write(repository / "namespace_metadata.json", json.dumps(listed))
        _write(repository / "CITATION.cff", citation_file(", ".join(sorted(sources))))
        write_episode_gallery(repository / "gallery.png", list(sources.values()))
        _write(repository / "README.md", "\n".join(_card(repository.name, entries)))


_LISTED = ("total_episodes", "total_steps", "algorithm_name")  # of a dataset's metadata


def _card(repository: str, entries: dict[str, dict[str, Any]]) -> list[str]:
    rows = [
        tuple(map(plain, (name, *(said.get(key, "") for key in _LISTED))))
        for name, said in sorted(entries.items())
    ]
    return [
        "---",
        "license: cc-by-4.0",
        "tags: [minari, knot-theory, gauss-code, mujoco, reinforcement-learning]",
        "task_categories: [reinforcement-learning]",
        "---",
        "",
        f"# Minari datasets: {plain(repository)}",
        "",
        "Trajectories of a closed rope in MuJoCo; goals are Gauss codes. With"
        " `MINARI_REMOTE=hf://USER`:",
        "",
        "```python",
        "import minari",
        "",
        f"dataset = minari.load_dataset({json.dumps(rows[0][0])}, download=True)",
        "```",
        "",
        "![the ends of episodes](gallery.png)",
        "",
        *table(("dataset", "episodes", "steps", "policy"), rows),
        "",
        "## What an episode holds",
        "",
        *table(("data", "holds"), _ROWS),
        "",
        *TO_CITE,
    ]


def _write(path: Path, text: str) -> None:
    path.write_text(text + ("" if text.endswith("\n") else "\n"), encoding="utf-8")
