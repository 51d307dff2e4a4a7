"""`python -m chebsplat.pipelines.cli`."""

from chebsplat.pipelines.cli import main

main()
