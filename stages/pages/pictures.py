"""Pictures of pages, as self-contained data URIs and inline SVG."""

from __future__ import annotations

import base64
import colorsys
import io
import textwrap
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib import colormaps
from PIL import Image

from chebsplat.stages.pages.measures import Course

IGNORE = -1
CURVES = (
    (("psnr",), "PSNR on watched training views, dB"),
    (("loss_color", "loss_features"), "loss: colour, disagreement with the teacher"),
    (("n",), "Gaussians"),
)
NAMED = {"psnr": "PSNR", "loss_color": "colour", "loss_features": "features"}


def palette(n: int) -> np.ndarray:
    """n distinguishable colours, u8 [n, 3]; hues by the golden ratio."""
    rows = [
        colorsys.hsv_to_rgb(0.618034 * k % 1, (0.55, 0.8)[k % 2], (0.95, 0.7, 0.85)[k % 3])
        for k in range(n)
    ]
    return (np.array(rows).reshape(n, 3) * 255).astype(np.uint8)


def colored(labels: np.ndarray, n: int) -> np.ndarray:
    """Label map [H, W] as an image; -1 is black."""
    return np.concatenate([np.zeros((1, 3), np.uint8), palette(n)])[labels.astype(int) + 1]


def heat(image: np.ndarray, relevancy: np.ndarray) -> np.ndarray:
    """A render u8 [H, W, 3] under a relevancy [H, W] as heat: grey up to 0.5, then cyan to red."""
    grey = image.mean(-1, keepdims=True)
    warmth = (2 * relevancy - 1).clip(0, 1)[..., None]
    opacity = np.where(warmth > 0, 0.5 + 0.4 * warmth, 0)
    return np.round(
        (1 - opacity) * 0.8 * grey + opacity * (0.7 + 0.3 * grey / 255) * warm(warmth)
    ).astype(np.uint8)


def warm(warmth: np.ndarray) -> np.ndarray:
    """Colours [..., 3] up to 255 of warmth [..., 1] in [0, 1], from the warmer part of turbo."""
    return 255 * colormaps["turbo"](0.3 + 0.58 * warmth[..., 0])[..., :3]


def error_map(image: np.ndarray, truth: np.ndarray, gain: float = 4.0) -> np.ndarray:
    """Mean absolute colour error of u8 images, `gain` times as strong, as an image."""
    error = np.abs(image.astype(np.float32) - truth).mean(-1) * (gain / 255)
    return (matplotlib.colormaps["inferno"](error.clip(0, 1))[..., :3] * 255).astype(np.uint8)


def wrong_map(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Red, u8 [H, W, 4], where predicted classes are wrong; clear where right or without truth."""
    wrong = (predicted != truth) & (truth != IGNORE)
    return np.where(wrong[..., None], np.array([230, 20, 40, 255], np.uint8), np.uint8(0))


def data_uri(image: np.ndarray, photo: bool = False) -> str:
    """WebP for photos, lossless PNG for anything with sharp edges and few colours."""
    picture, buffer = Image.fromarray(image), io.BytesIO()
    if photo:
        picture.save(buffer, "WEBP", quality=90)
    else:
        if image.shape[-1] == 3:
            picture = picture.quantize(256, dither=Image.Dither.NONE)
        picture.save(buffer, "PNG", optimize=True)
    return (
        f"data:image/{'webp' if photo else 'png'};base64,"
        + base64.b64encode(buffer.getvalue()).decode()
    )


def png(image: np.ndarray, path: Any) -> None:
    """Write an image u8 [H, W, 3] to a path or a file as PNG."""
    Image.fromarray(image).save(path, "PNG")


def svg(figure: Any) -> str:
    """A figure as inline SVG; closes it."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None}, transparent=True)
    plt.close(figure)
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def cameras(eyes: np.ndarray, ups: np.ndarray, points: np.ndarray, errors: np.ndarray) -> str:
    """Cameras and points from above and from the side, and each photo's error, as inline SVG.

    Args: eyes, ups: [V, 3] centres and upward directions of the cameras, in the order of the
      photos; points [N, 3]; errors: [V] pixels.
    """
    matplotlib.use("Agg")
    up = ups.mean(0) / max(np.linalg.norm(ups.mean(0)), 1e-9)
    across = np.linalg.svd(np.eye(3) - np.outer(up, up))[0][:, 0]
    axes = np.column_stack([across, np.cross(up, across), up])
    near = np.abs(points - np.median(points, 0)).max(1) if len(points) else np.zeros(0)
    cloud = points[near <= np.quantile(near, 0.95)] @ axes if len(points) else np.zeros((0, 3))
    cloud, path = cloud[:: max(len(cloud) // 1500, 1)], eyes @ axes
    with matplotlib.rc_context(
        {"svg.hashsalt": "cameras", "svg.fonttype": "none", "font.family": "sans-serif"}
    ):
        figure, panels = plt.subplots(1, 3, figsize=(12.6, 3.4), layout="constrained")
        for panel, (i, j), title in zip(
            panels, ((0, 1), (0, 2)), ("from above", "from the side"), strict=False
        ):
            panel.scatter(*cloud[:, [i, j]].T, s=1, color="#999999", linewidths=0)
            panel.plot(*path[:, [i, j]].T, color="#cccccc", linewidth=0.5)
            panel.scatter(*path[:, [i, j]].T, s=14, c=np.arange(len(path)), cmap="viridis")
            panel.set_aspect("equal", "datalim")
            panel.set_title(f"cameras and points {title}", fontsize=10)
            panel.tick_params(labelsize=7)
        panels[2].bar(np.arange(len(errors)), errors, color="#1f6feb")
        panels[2].set_title("error of each photo's points, pixels", fontsize=10)
        panels[2].set_xlabel("photos in their order", fontsize=8)
        return svg(figure)


def course(of: Course, test_psnr: float) -> str:
    """PSNR and accuracy of labels against seconds, over bands of the stages, as inline SVG."""
    matplotlib.use("Agg")
    with matplotlib.rc_context(
        {"svg.hashsalt": "course", "svg.fonttype": "none", "font.family": "sans-serif"}
    ):
        n = 2 if of.meanings else 1
        figure, panels = plt.subplots(
            n, 1, figsize=(12.6, 2.6 * n), layout="constrained", sharex=True, squeeze=False
        )
        last = max(of.spans[-1][2], 1e-3)
        for number, (stage, begin, end) in enumerate(of.spans):
            for panel in panels[:, 0]:
                panel.axvspan(
                    begin,
                    end,
                    color=colormaps["tab20"](2 * number % 20 + 1),
                    alpha=0.35,
                    linewidth=0,
                )
            if end - begin > 0.035 * last:
                top = panels[0, 0].get_xaxis_transform()
                panels[0, 0].text(
                    (begin + end) / 2, 1.02, stage, transform=top, ha="center", fontsize=8
                )
        panels[0, 0].plot(
            [0, of.training[0]], [of.plain] * 2, ":", color="#1f6feb", label="photos of one colour"
        )
        panels[0, 0].plot(
            *zip(*of.colors, strict=True),
            color="#1f6feb",
            marker=".",
            markersize=4,
            label="training views",
        )
        panels[0, 0].plot(
            [last],
            [test_psnr],
            "*",
            color="#e36209",
            markersize=11,
            label="test views",
            clip_on=False,
        )
        panels[0, 0].set_ylabel("PSNR, dB")
        panels[0, 0].legend(fontsize=8, frameon=False, loc="lower right")
        if of.meanings:
            stages, seconds, values = zip(*of.meanings, strict=True)
            panels[1, 0].plot(seconds, values, color="#1f6feb", marker="o", drawstyle="steps-post")
            for k, at in enumerate(zip(seconds, values, strict=True)):
                text = f"{stages[k]} {values[k]:.3f}"
                panels[1, 0].annotate(
                    text,
                    at,
                    (0, (7, -14)[k % 2]),
                    ha="right",
                    fontsize=8,
                    textcoords="offset points",
                )
            panels[1, 0].margins(y=0.3)
            panels[1, 0].set_ylabel(textwrap.fill(of.words, 32), fontsize=8)
        panels[-1, 0].set_xlabel("seconds from the start, stage after stage")
        panels[-1, 0].set_xlim(0, last)
        return svg(figure)


def curves(trace: list[dict[str, float]], test_psnr: float) -> list[str]:
    """Training curves as inline SVG: PSNR, with the test views' at the end; losses; Gaussians."""
    matplotlib.use("Agg")

    seconds = [row["seconds"] for row in trace]
    drawn = []
    for columns, title in CURVES:
        with matplotlib.rc_context(
            {"svg.hashsalt": title, "svg.fonttype": "none", "font.family": "sans-serif"}
        ):
            figure, axis = plt.subplots(figsize=(4.2, 2.9), layout="constrained")
            for color, column in zip(("#1f6feb", "#e36209"), columns, strict=False):
                if any(row.get(column) for row in trace):
                    values = [row[column] or np.nan for row in trace]
                    axis.plot(
                        seconds,
                        values,
                        color=color,
                        marker=".",
                        markersize=4,
                        label=NAMED.get(column),
                    )
            if columns == ("psnr",):
                axis.plot(
                    seconds[-1:],
                    [test_psnr],
                    "*",
                    color="#e36209",
                    markersize=11,
                    label="test views",
                )
            if columns != ("n",):
                axis.legend(fontsize=8, frameon=False)
            if columns[0].startswith("loss"):
                axis.set_yscale("log")
            if columns == ("n",):
                axis.set_ylim(bottom=0)
            axis.set_xlabel("training seconds")
            axis.set_title(title, fontsize=10)
            axis.grid(alpha=0.3)
            drawn.append(svg(figure))
    return drawn
