"""The command `knotgym images`."""

from pathlib import Path

from knotgym.cli.options import RUN, Given, command, default_folder, extra
from knotgym.generate.images.images_config import ImagesConfig


@command(
    {"": ImagesConfig},
    f"nx count appearance.style appearance.sizes=--size engine {RUN}",
    extra("out", Path, "Folder to write; by default knotgym-data/images-nx0-4 for --nx 0-4."),
    extra("states", Path, "Start from a states.h5; by default from the included states."),
    extra(
        "vary",
        tuple[str, ...],
        "What varies: all, none, or some of colours,width,background,turn,zoom,noise,blur.",
        ("none",),
    ),
)
def images(given: Given) -> None:
    """Generate labelled pictures for perception.

    Each comes with its Gauss code, crossings, rope coordinates and a grade of difficulty. Needs the
    extra huggingface: pip install '.[huggingface]'.

    Examples:

        knotgym images --nx 0-4 --count 20000

        knotgym images --nx 2,3 --count 500 --vary all --size 64,128

        knotgym images --nx 3,4 --count 100 --style knotbench
    """
    from knotgym.generate.images.image_recipe import make_images
    from knotgym.rendering.appearance_config import VARIED

    states, vary = given["states"], given["vary"]
    vary = {("all",): VARIED, ("none",): ()}.get(vary, vary)
    usual = {"appearance.vary": vary} if "vary" in given.typed else {}
    config = given.config(ImagesConfig, usual=usual)
    nx = ",".join(map(str, config.nx))
    if len(config.nx) > 1 and config.nx == tuple(range(config.nx[0], config.nx[-1] + 1)):
        nx = f"{config.nx[0]}-{config.nx[-1]}"
    look = config.appearance
    folder = given["out"] or default_folder(
        f"images-nx{nx}",
        "" if states is None else f"from-{states.absolute().parent.name}",
        "" if config.engine == "mujoco" else config.engine,
        "" if look.style == "published" else look.style,
        "varied" if look.vary else "",
        f"{'x'.join(map(str, look.sizes))}px" if given.has("appearance.sizes") else "",
        f"seed{config.seed}" if config.seed else "",
    )
    make_images(config, folder, given.run, states=states, progress=given.progress)
