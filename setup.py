"""Before a build: four folders of the package are links, where a zip's unpacking can leave files
with a path.
"""

from pathlib import Path

from setuptools import setup

for link in (
    Path(__file__).parent / "chebsplat" / name
    for name in ("formats", "pipelines", "stages", "teachers")
):
    if link.is_file():
        link.unlink()
        link.symlink_to(f"../{link.name}")

setup()
