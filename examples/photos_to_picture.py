"""From photos to a picture: python examples/photos_to_picture.py path/to/photos/ picture.png
[STEPS]

The first call trains the scene, a later one finds it done. A name of `chebsplat scenes`, such as
toy, will do, too.
"""

import sys

from PIL import Image

import chebsplat


def main(photos: str, out: str, steps: int = 3000) -> None:
    """Train, if need be, and write the first photo's view as the scene shows it."""
    scene = chebsplat.train(photos, train={"steps": steps})
    camera = scene.cameras[0]
    shown = scene.render(camera.resized(2 * camera.width, 2 * camera.height))
    Image.fromarray(shown.color).save(out)
    print(
        f"{camera.name}: {len(scene):,} Gaussians, {100 * (shown.alpha >= 0.5).mean():.0f} % of "
        "the picture covered"
    )


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], *map(int, sys.argv[3:]))
