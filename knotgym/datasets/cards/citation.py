"""Templates of cards, the citation, and escaping of text for Markdown and YAML."""

import html
import json
import re
from importlib.resources import files
from pathlib import Path
from string import Template

import knotgym

BIBTEX = """\
@misc{knotgym,
  title  = {knotgym: curated states, trajectories and labelled pictures of a closed rope},
  author = {{The knotgym founders}},
  year   = {2026},
  note   = {after "Knot So Simple", arXiv:2505.18028}
}"""
TO_CITE = ("## To cite", "", "```bibtex", BIBTEX, "```", "")  # lines of a card


def plain(text: object) -> str:
    """Escape untrusted text for Markdown: one line, without HTML, markup, links or mentions.

    >>> print(plain("<b>[a|b](http://c)"))
    &lt;b&gt;\\[a\\|b\\](http&#58;//c)
    """
    escaped = html.escape(_one_printable_line(text), quote=False)
    escaped = re.sub(r"([\\`*_\[\]|~$])", r"\\\1", escaped)
    # GitHub and Hugging Face turn bare URLs and mentions into links
    escaped = escaped.replace("://", "&#58;//").replace("@", "&#64;")
    return re.sub(r"(?i)\b(www)\.", r"\1&#46;", escaped)


def code_span(text: object) -> str:
    """Quote untrusted text as inline code; only a backtick or a table's bar could end it."""
    return "`" + _one_printable_line(text).replace("`", "'").replace("|", "\\|") + "`"


def yaml_string(text: object) -> str:
    """Quote untrusted text as a YAML string in double quotes."""
    return json.dumps(_one_printable_line(text), ensure_ascii=False)


def _one_printable_line(text: object) -> str:
    """Replace what can't be printed, such as line breaks and lone surrogates, by spaces."""
    return " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())


def citation_file(title: str) -> str:
    """Return the CITATION.cff of a dataset."""
    return filled(
        "citation.cff",
        title=yaml_string(f"knotgym: {title}"),
        version=json.dumps(knotgym.__version__),
    )


def filled(template: str, **parts: object) -> str:
    """Fill a text template of this package with texts, or lists of lines.

    `$to_cite` becomes the section with the BibTeX.
    """
    text = (files("knotgym.datasets.cards") / template).read_text(encoding="utf-8")
    lists = {name: "\n".join(part) for name, part in parts.items() if isinstance(part, list)}
    return Template(text).substitute({**parts, **lists}, to_cite="\n".join(TO_CITE))


def write_text(path: Path, text: str) -> None:
    """Write a text file that ends with a line break."""
    path.write_text(text + ("" if text.endswith("\n") else "\n"), encoding="utf-8")
