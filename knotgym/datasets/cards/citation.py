"""How the data are cited."""

from __future__ import annotations

import json

import knotgym

BIBTEX = """\
@misc{knotgym,
  title  = {knotgym: curated states, trajectories and labelled pictures of a closed rope},
  author = {{The knotgym founders}},
  year   = {2026},
  note   = {after "Knot So Simple", arXiv:2505.18028}
}"""
TO_CITE = ("## To cite", "", "```bibtex", BIBTEX, "```", "")  # the lines of a card


def citation_file(title: str) -> str:
    """CITATION.cff of a dataset."""
    return "\n".join(
        [
            "cff-version: 1.2.0",
            "message: If you use these data, please cite them as below.",
            f"title: {json.dumps(f'knotgym: {title}')}",
            "type: dataset",
            f"version: {json.dumps(knotgym.__version__)}",
            "license: CC-BY-4.0",
            "authors:",
            "  - name: The knotgym founders",
            "references:",
            "  - type: conference-paper",
            '    title: "Knot So Simple: A Minimalistic Environment for Spatial Reasoning"',
            "    authors:",
            "      - family-names: Chen",
            "        given-names: Zizhao",
            "      - family-names: Artzi",
            "        given-names: Yoav",
            "    collection-title: NeurIPS",
            "    year: 2025",
            "",
        ]
    )
