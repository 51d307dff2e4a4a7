"""Ask a finished scene for a thing and take it out: python examples/ask_and_take.py work/office0
sofa sofa.ply
"""

import sys

import chebsplat


def main(folder: str, word: str, out: str) -> None:
    """Say whether the scene has it, and where; write what is selected as a PLY."""
    scene = chebsplat.load(folder)
    answer = scene.ask(word)
    print(answer)
    if answer.present is False or not answer.selected.any():
        return
    part = scene.select(answer.selected)
    means, _ = part.points()
    low, high = means.min(0), means.max(0)
    print(
        f"centres from {low.round(2).tolist()} to {high.round(2).tolist()}, scene units; "
        f"{part.export(out)}"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
