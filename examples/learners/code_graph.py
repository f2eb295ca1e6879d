"""Put a graph of codes above a network: a hierarchy of two levels.

    python examples/learners/offline_torch.py NextBC SET --action macro --out near.pt
    python examples/learners/code_graph.py near.pt SET --out far.json

Writes far.json and far.py, a policy: `knotgym evaluate --policy far:act`, in the same folder. An
edge leads from a code to each that one macro-action of SET led to; it costs the more the rarer it
is. The policy takes the first code on the cheapest path to the goal, and lets the network, which
learned to show the code that follows, pull towards it.
"""

import ast
import inspect
import json
import time
from collections import Counter
from collections.abc import Callable
from functools import cache
from heapq import heappop, heappush
from math import log
from pathlib import Path
from typing import Any

from cards import card_of
from cyclopts import run
from diagram_values import code_of

from knotgym.envs import Marked
from knotgym.loaders import arrays, as_policy
from knotgym.topology import GaussCode, images

MODULE = """import json
from collections.abc import Callable
from functools import cache
from heapq import heappop, heappush
from math import log
from pathlib import Path
from typing import Any

from {near} import FILES as NEAR
from {near} import predict
from knotgym.envs import Marked
from knotgym.loaders import as_policy
from knotgym.topology import GaussCode
from numpy.typing import NDArray

FILES = [__file__[:-3] + ".json", *NEAR]
CARD = {card}  # what an entry claims of the training


{functions}

act = policy_of(FILES[0], predict)
"""


def policy_of(file: str, pulls: Callable[[Any], Any]) -> Any:
    """Return the policy of a graph and of a network that pulls towards codes."""
    graph: dict[str, dict[str, int]] = json.loads(Path(file).read_text())

    @cache
    def first(code: str, goal: str) -> str:
        """Return the first code of the cheapest path, or the goal if there is none."""
        heap, done = [(0.0, code, goal)], set[str]()
        while heap:
            cost, at, began = heappop(heap)
            if at == goal:
                return began
            if at not in done:
                done.add(at)
                total = sum(graph.get(at, {}).values())
                for new, count in graph.get(at, {}).items():
                    heappush(heap, (cost - log(count / total), new, new if at == code else began))
        return goal

    def predict(observations: Any) -> Any:
        marked = Marked.split(observations)
        codes = [code_of(one) for one in marked.goal]
        for row, tokens in enumerate(marked.code):
            if not tokens[-1, 0]:  # else it is cut off
                pair = str(code_of(tokens)), str(codes[row])
                codes[row] = GaussCode.parse(first(*pair))
        near = Marked.of(marked.points, codes)  # whose frame may be another
        seen = near._replace(frames=marked.frames).joined()
        return near.frames.macros(pulls(seen), marked.points.shape[1])

    return as_policy(predict, action="macro")


def graph_of(dataset: str) -> dict[str, dict[str, int]]:
    """Count which codes the macro-actions of a dataset led to, with all images of both."""
    data = arrays(dataset, observation="symbolic", action="macro")
    kept = ~data["timeouts"]  # the last of an episode may be cut short
    shown = (data[name][kept, 0].tolist() for name in ("observations", "next_observations"))
    passes = Counter(
        tuple(tuple(filter(None, one)) for one in pair) for pair in zip(*shown, strict=True)
    )
    graph: dict[str, Counter[str]] = {}
    for (old, new), count in passes.items():
        if old != new:
            both = (images(GaussCode(one)) for one in (old, new))
            for before, after in {tuple(map(str, pair)) for pair in zip(*both, strict=True)}:
                graph.setdefault(before, Counter())[after] += count
    return {code: dict(sorted(found.items())) for code, found in sorted(graph.items())}


def make(near: Path, dataset: str, *, out: Path) -> None:
    """Write the graph of a dataset, and the policy of it and of a network.

    Args:
        near: weights of NextBC, trained on macro-actions.
        dataset: Minari id or folder of a set of macro-actions.
        out: graph; in the weights' folder.
    """
    began = time.process_time()
    out.write_text(json.dumps(graph_of(dataset)))
    source = near.with_suffix(".py").read_text()
    below = ast.literal_eval(source.partition("CARD = ")[2].partition("  # what")[0])
    words = __file__, near.name, dataset, "--out", out.name
    seconds = below["seconds"] + time.process_time() - began
    own = card_of(f"graph of codes over {below['learner']}", [dataset], seconds, words)
    card = below | own | {"data": below["data"] | own["data"]}
    functions = "\n\n".join(inspect.getsource(one) for one in (code_of, policy_of))
    module = MODULE.format(near=near.stem, card=card, functions=functions)
    out.with_suffix(".py").write_text(module)


if __name__ == "__main__":
    run(make)
