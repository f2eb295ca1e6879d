"""Datasets as learners want them: arrays, windows, views of actions, torch, d3rlpy, TensorDict. It
never writes a dataset. Read `transitions.py` first.

Every loader takes a dataset as a Minari id, a folder, an episode file (compact or not), a
`minari.MinariDataset`, or the output folder of `knotgym generate` (for its demonstrations of the
train split); or a list of them, which is read into memory as one. The other arguments are

    observation     "pixels", "state", "both", "symbolic" or "marked"; None for the observation of
                    the dataset's environment
    picture         a `knotgym.rendering.camera.PictureConfig`, to render pictures with another
                    size, camera, colours or views, with or without depth
    action          "pull", "bead", "macro" or "decision", a view of the actions
                    (`knotgym.rope.action_views`); None for that of the dataset's environment. The
                    last two need a dataset that records macro-actions
    frame           "world" or "canonical", of actions and vertices (`knotgym.TaskConfig`); None for
                    that of the dataset's environment. `as_policy` turns actions back
    relabel         hindsight relabelling, "last" or "all": a code that was reached becomes the goal
                    (see `Transitions`)
    labels          True to use the expert's actions instead of those taken, if the dataset has them
                    (`knotgym collect --set labels=expert`)
    cache           a folder for uncompressed pictures. They are drawn once, on first use, and
                    mapped into memory, which makes random batches fast. The pictures are the same,
                    byte for byte
    window          a `Window`: n-step returns, chunks of actions, stacks of observations, a history
                    of actions, and goals sampled as in OGBench (`GoalSampling`)
    reward          a function of an episode and its steps that returns your own rewards

Torch, d3rlpy and TensorDict are imported only by the loaders that need them, and the names below
only when first used.
"""

import lazy_loader

if __name__ == "loaders":
    raise ImportError(
        "this is the link `loaders` at the top of a checkout of knotgym: import knotgym.loaders"
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
