"""Nothing that is read is run: no import by a computed name, but where it is listed with why.

Ruff's rules S refuse exec, eval and pickle.
"""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1] / "knotgym"
# file -> why a module that it imports by a computed name isn't named by data
IMPORTS = {
    "cli/program.py": "packages that installed entry points name",
    "common/configurations.py": "plugins, which the user types or installed entry points name",
    "common/errors.py": "optional libraries, names in the code",
    "control/own_policies.py": "module:name, which the user types; never from a file",
    "control/policies.py": "modules of its room, names in the code",
    "control/policy_config.py": "the table of policies of its room, named in the code",
    "datasets/exports/__init__.py": "functions of its table, named in the code",
    "generate/generate_config.py": "its recipe, named in the code",
    "learn/learners.py": "classes of its table, named in the code",
    "prompting/chat.py": "the HTTP library of the client that is installed",
    "rope/engines.py": "simulations and kernels of engines, named in the code",
    "states/sources.py": "recipes of sources, named in the code; a file names a source, not code",
    "rendering/mujoco_renderer.py": "backends of MuJoCo, names in the code",
    "rendering/variation.py": "painters of appearances, named in the code",
}


RUNNING = re.compile(r"\b(?:__import__|import_module|resolve_name|run_path|run_module)\(")
UNPICKLING = re.compile(
    r"allow_pickle=(?!False)|torch\.load\((?!.*weights_only=True)"
    r"|(?:import|from) (?:c?Pickle|pickle|dill|cloudpickle|joblib|marshal|shelve)\b"
)


def test_nothing_that_is_read_is_run() -> None:
    files = {path.relative_to(ROOT).as_posix(): path.read_text() for path in ROOT.rglob("*.py")}
    assert {path for path, text in files.items() if RUNNING.search(text)} == {*IMPORTS}
    assert [path for path, text in files.items() if UNPICKLING.search(text)] == []
