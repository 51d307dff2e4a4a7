from chebsplat.pipelines.api import load, run_stage, train

__all__ = ("load", "run_stage", "train")
__version__: str
