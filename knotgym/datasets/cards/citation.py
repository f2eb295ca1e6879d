"""How the data are cited."""

from __future__ import annotations

import html
import json
import re

import knotgym

BIBTEX = """\
@misc{knotgym,
  title  = {knotgym: curated states, trajectories and labelled pictures of a closed rope},
  author = {{The knotgym founders}},
  year   = {2026},
  note   = {after "Knot So Simple", arXiv:2505.18028}
}"""
TO_CITE = ("## To cite", "", "```bibtex", BIBTEX, "```", "")  # the lines of a card


def plain(text: object) -> str:
    """Escape text of a file or a user, so that Markdown shows it and nothing else: on one line,
    without HTML, markup, links or mentions.

    >>> print(plain("<b>[a|b](http://c)"))
    &lt;b&gt;\\[a\\|b\\](http&#58;//c)
    """
    escaped = html.escape(one_printable_line(text), quote=False)
    escaped = re.sub(r"([\\`*_\[\]|~$])", r"\\\1", escaped)
    # GitHub and Hugging Face make links of these without any markup
    escaped = escaped.replace("://", "&#58;//").replace("@", "&#64;")
    return re.sub(r"(?i)\b(www)\.", r"\1&#46;", escaped)


def code_span(text: object) -> str:
    """Such text as inline code, in which nothing but a backtick or a table's bar has a meaning."""
    return "`" + one_printable_line(text).replace("`", "'").replace("|", "\\|") + "`"


def yaml_string(text: object) -> str:
    """Such text as a YAML string in double quotes."""
    return json.dumps(one_printable_line(text), ensure_ascii=False)


def one_printable_line(text: object) -> str:
    """Text with a space for whatever can't be printed: line breaks, half surrogate pairs."""
    return " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())


def citation_file(title: str) -> str:
    """CITATION.cff of a dataset."""
    return "\n".join(
        [
            "cff-version: 1.2.0",
            "message: If you use these data, please cite them as below.",
            f"title: {yaml_string(f'knotgym: {title}')}",
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
