"""The command `knotgym compile`."""

import tempfile
from pathlib import Path

from knotgym.cli.options import Given, command


@command({}, "")
def compile(given: Given) -> None:
    """Compile the numerical kernels ahead of time, in about a minute of CPU time."""
    from knotgym.control.policy_config import PolicyConfig, PullPlannerConfig
    from knotgym.envs.tasks import TaskConfig
    from knotgym.generate.episodes.collect import collect
    from knotgym.generate.episodes.collect_config import CollectConfig
    from knotgym.generate.states.generate_config import GenerateConfig
    from knotgym.generate.states.state_recipe import make_states
    from knotgym.loaders import arrays
    from knotgym.rope.engines import CHAIN, compile_engine
    from knotgym.runs.progress import Progress
    from knotgym.runs.run_options import RunOptions
    from knotgym.topology.crossing_kernel import scan

    progress = given.progress
    options, silent = RunOptions(workers=1, quiet=True), Progress(quiet=True)
    with tempfile.TemporaryDirectory(prefix="knotgym-compile-") as temporary:
        folder = Path(temporary)
        progress.stage("compiling the kernels that draw, relax and measure states")
        states = GenerateConfig(nx=(1,), count=1, demonstrations=False)
        make_states(states, folder / "states", options, progress=silent)
        progress.stage("compiling the chain engine")
        compile_engine(CHAIN)
        progress.stage("compiling the kernels that simulate, plan and render")
        config = CollectConfig(
            task=TaskConfig(task="tie", nx=1, horizon=2, observation="state"),
            policy=PolicyConfig(policy="expert", planner=PullPlannerConfig(budget=64)),
            episodes=1,
        )
        arrays(collect(config, folder, options, progress=silent), observation="both")
    progress.say(f"compiled; the machine code is kept in {scan.stats.cache_path}")
