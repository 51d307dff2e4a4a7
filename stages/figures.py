"""Pictures of the report, as self-contained data URIs."""

from __future__ import annotations

import base64
import colorsys
import io
from typing import Any

import numpy as np


def palette(n: int) -> np.ndarray:
    """n distinguishable colours, u8 [n, 3]; hues by the golden ratio."""
    rows = [colorsys.hsv_to_rgb(0.618034 * k % 1, (0.55, 0.8)[k % 2], (0.95, 0.7, 0.85)[k % 3]) for k in range(n)]
    return (np.array(rows).reshape(n, 3) * 255).astype(np.uint8)


def colored(labels: np.ndarray, n: int) -> np.ndarray:
    """Label map [H, W] as an image; -1 is black."""
    return np.concatenate([np.zeros((1, 3), np.uint8), palette(n)])[labels.astype(int) + 1]


def heat(image: np.ndarray, relevancy: np.ndarray) -> np.ndarray:
    """A render u8 [H, W, 3] under the heat of a relevancy [H, W]: grey up to 0.5, then cyan to red at 1."""
    grey = image.mean(-1, keepdims=True)
    warmth = (2 * relevancy - 1).clip(0, 1)[..., None]
    opacity = np.where(warmth > 0, 0.5 + 0.4 * warmth, 0)
    return np.round((1 - opacity) * 0.8 * grey + opacity * (0.7 + 0.3 * grey / 255) * _warm(warmth)).astype(np.uint8)


def heat_scale(title: str, width: int) -> np.ndarray:
    """A strip u8 [28, width, 3]: the title, and the colours of `heat` from 0.5 to 1."""
    from PIL import Image, ImageDraw

    strip = np.full((28, width, 3), 255, np.uint8)
    left, right = round(0.82 * width), round(0.97 * width)
    strip[9:19, left:right] = _warm(np.linspace(0, 1, right - left)[None, :, None]).round()
    picture = Image.fromarray(strip)
    draw, room = ImageDraw.Draw(picture), max(left - 40, 0) // 6  # letters of the built-in font
    draw.text((8, 8), title if len(title) <= room else f"{title[: max(room - 3, 0)]}...", fill="black")
    draw.text((left - 22, 8), "0.5", fill="black")
    draw.text((right + 6, 8), "1", fill="black")
    return np.asarray(picture)


def _warm(warmth: np.ndarray) -> np.ndarray:
    """Colours [..., 3] up to 255 of warmth [..., 1] in [0, 1], from the warmer part of turbo."""
    from matplotlib import colormaps

    return 255 * colormaps["turbo"](0.3 + 0.58 * warmth[..., 0])[..., :3]


def data_uri(image: np.ndarray) -> str:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def png(image: np.ndarray, path: Any) -> None:
    from PIL import Image

    Image.fromarray(image).save(path, "PNG")


def curve(trace: list[dict[str, float]]) -> str:
    """Error against run time: held-in PSNR, loss and number of Gaussians over seconds, as inline SVG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    seconds = [row["seconds"] for row in trace]
    figure, axes = plt.subplots(1, 3, figsize=(11, 3), layout="constrained")
    for axis, column, title in zip(
        axes, ("psnr", "loss", "n"), ("held-in PSNR, dB", "total loss", "Gaussians"), strict=True
    ):
        axis.plot(seconds, [row[column] for row in trace], color="#2b6cb0", marker=".", markersize=3)
        axis.set_xlabel("training seconds")
        axis.set_title(title, fontsize=10)
        axis.grid(alpha=0.3)
    axes[1].set_yscale("log")
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "chebsplat"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    plt.close(figure)
    text = buffer.getvalue()
    return text[text.index("<svg") :]
