"""The command `knotgym images`."""

from pathlib import Path

from knotgym.cli.options import RUN, Given, as_typed, command, extra
from knotgym.generate import ImagesConfig


@command(
    {"": ImagesConfig},
    f"nx count appearance.style appearance.sizes=--size engine {RUN}",
    extra("out", Path),
    extra("states", str),
    extra("vary", tuple[str, ...], ("none",)),
)
def images(given: Given) -> None:
    """Generate labelled pictures for perception.

    Each comes with its Gauss code, crossings, rope coordinates and a grade of difficulty. Needs the
    extra huggingface: pip install '.[huggingface]'.

    Examples:

        knotgym images --nx 0-4 --count 20000

        knotgym images --nx 2,3 --count 500 --vary all --size 64,128

        knotgym images --nx 3,4 --count 100 --style knotbench

        knotgym images --nx 1-4 --count 1000 --style photo --size 256

    Args:
        out: Folder to write; by default knotgym-data/images-nx0-4 for --nx 0-4.
        states: Start from a set of states: readable (default), bench, random-walk or hard-unknots,
            which are included; or a states.h5.
        vary: What varies: all, none, or some of colours,width,background,turn,zoom,noise,blur.
    """
    from knotgym.generate import make_images
    from knotgym.rendering import VARIED
    from knotgym.states import is_bundled

    states, vary = given["states"], given["vary"]
    vary = {("all",): VARIED, ("none",): ()}.get(vary, vary)
    usual = {"appearance.vary": vary} if "vary" in given.typed else {}
    config = given.config(ImagesConfig, usual=usual)
    whence = states if is_bundled(states) else Path(states).absolute().parent.name
    marks = [f"-from-{whence}" if states else ""]
    marks += ["-varied" if config.appearance.vary else ""]
    folder = given.folder(f"images-nx{as_typed(config.nx)}{''.join(marks)}")
    make_images(config, folder, given.run, states=states, progress=given.progress)
