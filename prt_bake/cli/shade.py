"""`prtbake shade`: a baked asset under a sky."""

from pathlib import Path
from typing import Annotated

import typer

from prt_bake.cli.options import (
    IMAGE_SUFFIXES,
    Exposure,
    Eye,
    Light,
    Mend,
    PictureSize,
    Rotate,
    Size,
    Up,
    output_option,
)
from prt_bake.cli.progress import say


def shade(
    asset: Annotated[Path, typer.Argument(metavar="ASSET", help="Asset that `prtbake bake` wrote.")],
    light: Light,
    output: Annotated[Path, output_option("IMAGE", *IMAGE_SUFFIXES)],
    size: PictureSize = Size(640, 480),
    eye: Eye = None,
    up: Up = None,
    rotate: Rotate = 0.0,
    exposure: Exposure = 0.0,
    samples: Annotated[int, typer.Option(min=1, max=64, help="Rays along each side of a pixel.")] = 3,
    mend: Mend = False,
) -> None:
    """Relight a baked asset and write the picture.

    It shows the light from under the surface, with the sky behind the object.
    """
    from formats.asset import read_asset
    from formats.image import write_image
    from prt_bake import camera
    from prt_bake.environment import read_environment
    from prt_bake.shading import render_picture

    baked, sky = read_asset(asset), read_environment(light, mend, say)
    view = camera.fit(baked.mesh, size.width, size.height, eye=eye, up=up or baked.up)
    picture = render_picture(baked, sky, view, up=up, rotate=rotate, samples=samples)
    write_image(output, picture.image, exposure=exposure)
    for item in baked.left_out:
        if item["item"].startswith("other "):
            say(f"{asset}: {item['item']} are left out: {item['reason']}")
    if not baked.complete:
        say(f"{asset}: is a partial bake; {picture.unlit:.1%} of what is seen of the object was not baked and is black")
    print(
        f"{output}: {picture.shaded} vertices in {picture.seconds:.2f} s, negative radiance clamped "
        f"{abs(picture.clamped):.3%} of the energy"
    )
