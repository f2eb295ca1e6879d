"""The commands `knotgym demo` and `knotgym compile`."""

import importlib.util
import tempfile
from pathlib import Path

from knotgym.cli.options import Given, Option, command, option, options_of, run_options
from knotgym.runs.progress import Progress


def _demo_options() -> list[Option]:
    from knotgym.generate.episodes.collect import CollectConfig

    return [
        option("--out", Path, "Folder to make.", default=Path("knotgym-data/demo")),
        *options_of(CollectConfig(), "seed"),
        *run_options("overwrite quiet"),
    ]


@command(_demo_options)
def demo(given: Given) -> None:
    """Film the expert tying a knot diagram, in about 20 seconds.

    Writes an observation, a film and an HTML page.
    """
    progress, out, overwrite = given.progress, given["out"], given["overwrite"]
    progress.stage("loading the simulator")
    from PIL import Image

    from knotgym.cli.inspection import page
    from knotgym.common.atomic_files import atomic_write, require_output
    from knotgym.control.policies import PolicyConfig
    from knotgym.datasets.episode_reader import EpisodeReader
    from knotgym.envs.tasks import TaskConfig
    from knotgym.generate.episodes.collect import CollectConfig, collect
    from knotgym.generate.episodes.evaluate import film
    from knotgym.rendering.video import write_film
    from knotgym.runs.compilation import compile_first
    from knotgym.runs.run_options import RunOptions

    require_output(out, folder=True, overwrite=overwrite)
    compile_first(progress)
    config = CollectConfig(
        task=TaskConfig(task="tie", nx=3, split="test", observation="both"),
        policy=PolicyConfig(policy="expert"),
        episodes=2,
        seed=given["seed"],
    )
    film_name = "expert.mp4" if importlib.util.find_spec("av") else "expert.gif"
    with atomic_write(out, overwrite=overwrite) as folder:
        folder.mkdir()
        progress.stage("the expert plays two episodes of tie with 3 crossings")
        options = RunOptions(workers=1, quiet=True)
        dataset = collect(config, folder / "minari", options, progress=Progress(quiet=True))
        reader = EpisodeReader(dataset)
        first = Image.fromarray(reader.observations(0, slice(0, 1), observation="pixels")[0])
        first.resize((4 * first.width, 4 * first.height), Image.Resampling.NEAREST).save(
            folder / "reset.png"
        )
        progress.stage("drawing the film and the page")
        episodes = list(reader)
        reader.close()
        frames = [frame for one in episodes for frame in film(one, config.task)]
        write_film(folder / film_name, frames)
        page(str(dataset), folder / "page.html", overwrite=False)
    reached = sum(bool(one.is_success.any()) for one in episodes)
    progress.say(f"{out / 'reset.png'}: the first observation, with the rope beside its goal")
    progress.say(f"{out / film_name}: the expert reaches the goal in {reached} of 2 episodes")
    progress.say(f"{out / 'page.html'}: the same episodes, to play and rotate in a browser")
    progress.say("next: knotgym-generate --nx 3 --count 40, or the example in the README")


@command(lambda: run_options("quiet"))
def compile_kernels(given: Given) -> None:
    """Compile the numerical kernels ahead of time, in about a minute of CPU time."""
    from knotgym.control.planning import PullPlannerConfig
    from knotgym.control.policies import PolicyConfig
    from knotgym.envs.tasks import TaskConfig
    from knotgym.generate.episodes.collect import CollectConfig, collect
    from knotgym.generate.states.generate_config import GenerateConfig
    from knotgym.generate.states.state_recipe import generate
    from knotgym.loaders import arrays
    from knotgym.rope.engines import CHAIN, compile_engine
    from knotgym.runs.run_options import RunOptions
    from knotgym.topology.crossing_kernel import scan

    progress = given.progress
    options, silent = RunOptions(workers=1, quiet=True), Progress(quiet=True)
    with tempfile.TemporaryDirectory(prefix="knotgym-compile-") as temporary:
        folder = Path(temporary)
        progress.stage("compiling the kernels that draw, relax and measure states")
        states = GenerateConfig(nx=(1,), count=1, demonstrations=False)
        generate(states, folder / "states", options, progress=silent)
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
