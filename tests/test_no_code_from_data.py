"""Nothing that is read is run: no call that would, but at the places that are listed with why."""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1] / "knotgym"
RUNNING = {"eval", "exec", "compile", "__import__", "import_module", "run_path", "run_module"}
RUNNING |= {"resolve_name"}  # of pkgutil
UNPICKLING = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve"}

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
    "prompting/chat.py": "the HTTP library of the client that is installed",
    "rope/engines.py": "simulations and kernels of engines, named in the code",
    "states/sources.py": "recipes of sources, named in the code; a file names a source, not code",
    "rendering/mujoco_renderer.py": "backends of MuJoCo, names in the code",
    "rendering/variation.py": "painters of appearances, named in the code",
}


def called(node: ast.Call) -> str:
    """The dotted name of what is called, as far as it is one."""
    parts: list[str] = []
    at = node.func
    while isinstance(at, ast.Attribute):
        parts.append(at.attr)
        at = at.value
    return ".".join([*([at.id] if isinstance(at, ast.Name) else ["?"]), *reversed(parts)])


def running(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and name of every call that runs, imports or unpickles what it is given."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [one.name for one in node.names] + [getattr(node, "module", None) or ""]
            yield from ((node.lineno, name) for name in names if name.split(".")[0] in UNPICKLING)
        if not isinstance(node, ast.Call):
            continue
        name = called(node)
        options = {one.arg: one.value for one in node.keywords}
        last = name.split(".")[-1]
        if name in RUNNING or last in RUNNING - {"eval", "compile"}:
            yield node.lineno, last
        if isinstance(options.get("allow_pickle"), ast.expr):
            if getattr(options["allow_pickle"], "value", None) is not False:
                yield node.lineno, "allow_pickle"
        if name == "torch.load" and getattr(options.get("weights_only"), "value", None) is not True:
            yield node.lineno, "torch.load"


def test_nothing_that_is_read_is_run() -> None:
    found = {
        (path.relative_to(ROOT).as_posix(), name.replace("resolve_name", "import_module"))
        for path in sorted(ROOT.rglob("*.py"))
        for _, name in running(ast.parse(path.read_text(encoding="utf-8")))
    }
    assert found == {(path, "import_module") for path in IMPORTS}
