"""The identity of a run: everything that determines its output, as JSON.

It is in the journal of a run and in the manifest of its output. A run can only be continued, merged
or recognized as finished if its identity is the same; otherwise the error names the differences.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np

import knotgym
from knotgym.common import (
    InvalidInput,
    Mark,
    as_json,
    by_name,
    code_sha256,
    differences,
    merged,
    plugins,
    read_json,
    sha256,
)
from knotgym.rope import RopeConfig
from knotgym.states import is_bundled, resolve_states

FIELDS = ("config", "source", "versions", "rope")


class Identity(dict[str, Any]):
    """Everything that determines the output of a run, as JSON.

    Attributes:
        files: the files that the run reads, in the form of `source`, which has their digests.
    """

    files: Mapping[str, Any] = {}

    @property
    def reads(self) -> list[Path]:
        """The files that the run reads."""
        files: list[Path] = []
        _digests(self.files, files.append)
        return files

    def require_unchanged(self) -> None:
        """Raise InvalidInput if a file has changed since."""
        if changed := list(differences(self.get("source") or {}, _digests(self.files), "source")):
            raise InvalidInput(f"a source changed, so nothing is written: {changed[0]}")


def identity(
    config: Any,
    files: Mapping[str, Any] | None = None,
    *,
    also: Iterable[Any] = (),
    fields: Mapping[str, Any] | None = None,
) -> Identity:
    """Return the identity of a run.

    The files that fields with the marks "states" and "policy" name are read and digested here.

    Args:
        config: its configuration.
        files: others that are read, by names; nested as in `source`. Texts stay as they are.
        also: of other policies whose files are read.
        fields: what of the configuration determines the output, as JSON; all by default.

    Raises:
        MissingFile, InvalidFile: a file can't be read.
        InvalidPolicy: nor that of a policy.
    """
    sources: dict[str, Any] = {}
    if states := [named for _, _, named in Mark.fields(type(config), config, "states")]:
        pairs = [("shipped" if is_bundled(s) else "own", resolve_states(s)) for s in states]
        sources["states"] = by_name(pairs)
    for part in (config, *also):
        for _, owner, named in Mark.fields(type(part), part, "policy"):
            sources.setdefault("policies", {})[named] = owner.files()
    if used := plugins():
        sources["plugins"] = used
    sources = merged(sources, files or {})
    whole = {
        "config": as_json(config) if fields is None else fields,
        "source": _digests(sources) or None,
        "versions": versions(),
        "rope": RopeConfig().fingerprint,
    }
    made = Identity(json.loads(json.dumps(whole)))
    made.files = sources
    return made


def _digests(files: Any, digest: Callable[[Path], Any] = sha256) -> Any:
    """Replace paths by the SHA-256 of their files, or by what another function returns."""
    return json.loads(json.dumps(files, default=digest, sort_keys=True))


def versions() -> dict[str, str]:
    """Return the versions of everything that could change the output.

    `code` is a digest of this package's modules and data, to distinguish edits within a version.
    """
    return {
        "knotgym": knotgym.__version__,
        "code": code_sha256(Path(knotgym.__file__).parent, "cli"),  # which changes no output
        "mujoco": mujoco.__version__,
        "numpy": np.__version__,
        "opencv": cv2.__version__,
    }


def identity_of(out: Path, place: str | Callable[[Path], Any]) -> dict[str, Any] | None:
    """Return the identity in an output, see `run`; None if unknown."""
    try:
        read = place if callable(place) else read_json
        content = read(out / place if isinstance(place, str) and out.is_dir() else out)
        content = content.get("identity", content)
        return {name: content[name] for name in FIELDS}
    except (AttributeError, OSError, ValueError, KeyError, TypeError):
        return None
