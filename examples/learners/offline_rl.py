"""Train a learner of d3rlpy on decisions: behaviour cloning, TD3+BC, IQL, CQL, AWAC or CRR.

    python examples/learners/offline_rl.py IQL knotgym/tie-nx2/noisy-bench-v0 --out iql.d3

Writes iql.d3 and iql.py, a policy: `knotgym evaluate --policy iql:act`, in the same folder.
"""

import argparse
from pathlib import Path

import d3rlpy

from knotgym.loaders import to_d3rlpy

MODULE = """import d3rlpy
from knotgym.loaders import as_policy

FILES = [__file__[:-3] + ".d3"]
act = as_policy(d3rlpy.load_learnable(FILES[0]).predict)
"""

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("learner", choices=("BC", "TD3PlusBC", "IQL", "CQL", "AWAC", "CRR"))
parser.add_argument("datasets", nargs="+", help="Minari ids or folders, of the train split")
parser.add_argument("--steps", type=int, default=4000)
parser.add_argument("--batch", type=int, default=256)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--device", default="cpu:0")
parser.add_argument("--out", type=Path, required=True, help="file of the model to write")
given = parser.parse_args()
d3rlpy.seed(given.seed)
buffer = to_d3rlpy(given.datasets, observation="marked", action="decision", frame="canonical")
kind = getattr(d3rlpy.algos, f"{given.learner}Config")
layers = d3rlpy.models.VectorEncoderFactory([512, 512], use_layer_norm=True, dropout_rate=0.1)
parts = {name: layers for name in kind.__dataclass_fields__ if name.endswith("encoder_factory")}
scaler = d3rlpy.preprocessing.StandardObservationScaler()
learner = kind(batch_size=given.batch, observation_scaler=scaler, **parts).create(given.device)
learner.fit(buffer, n_steps=given.steps, n_steps_per_epoch=given.steps)
learner.save(str(given.out))
given.out.with_suffix(".py").write_text(MODULE)
