"""Views: one camera at one resolution, what lies in its frustum, the photos of a training."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

DEVICE_BYTES = 1 << 30  # of a GPU, for features of views, and for their depth


@dataclass
class View:
    """One camera at one resolution. K [3, 3] pixels, viewmat [4, 4], float32."""

    K: Tensor
    viewmat: Tensor
    width: int
    height: int

    def to(self, device: str | torch.device) -> View:
        """The same camera, its matrices on a device."""
        return View(self.K.to(device), self.viewmat.to(device), self.width, self.height)


def in_frustum(means: Tensor, view: View, reach: Tensor) -> Tensor:
    """Indices of the points of which `may_be_seen` is true."""
    return may_be_seen(means, view, reach).nonzero()[:, 0]


def may_be_seen(means: Tensor, view: View, reach: Tensor, margin: float = 0.15) -> Tensor:
    """True for points whose spheres of radius `reach` [N] may touch the image, [N]; not for NaN."""
    camera = means @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    x, y, z = camera.unbind(-1)
    half_x, half_y = 0.5 * view.width * (1 + margin), 0.5 * view.height * (1 + margin)
    fx, fy = view.K[0, 0], view.K[1, 1]
    u = fx * x + (view.K[0, 2] - 0.5 * view.width) * z
    v = fy * y + (view.K[1, 2] - 0.5 * view.height) * z
    near = z + reach > 0.01
    inside = (u.abs() <= half_x * z.clamp_min(0) + (fx + half_x) * reach) & (
        v.abs() <= half_y * z.clamp_min(0) + (fy + half_y) * reach
    )
    return near & inside


def remembered(read: Callable[[Any], Tensor], budget: int) -> Callable[[Any], Tensor]:
    """`read`, whose results stay in memory while `budget` bytes last; the others are read at every
    call.

    Choices: what came first stays. Views are visited in random order, once a round: to drop the
      least recently used for another would lose it before it is needed again.
    """
    cached: dict[Hashable, Tensor] = {}
    left = budget

    def recall(index: Hashable) -> Tensor:
        nonlocal left
        if index in cached:
            return cached[index]
        value = read(index)
        if value.nbytes <= left:
            cached[index] = value
            left -= value.nbytes
        return value

    return recall


class Stored:
    """Arrays [V, ...] of views, indexed as a tensor would be and read on access: `read(view)` is a
    tensor, and what fits into `budget` bytes stays in memory.
    """

    def __init__(self, read: Callable[[int], Tensor], count: int, budget: int):
        self.read = remembered(read, budget)
        self.shape = (count, *self.read(0).shape)

    def __getitem__(self, index: int) -> Tensor:
        return self.read(index)

    def to(self, device: str | torch.device) -> Stored:
        """The same arrays, each taken to a device when it is read."""
        return Stored(lambda index: self.read(index).to(device), self.shape[0], 0)


def stacked(read: Callable[[int], Tensor], count: int, budget: int) -> Tensor | Stored:
    """Arrays [V, ...] of views, in memory if they fit into `budget` bytes, else read when used."""
    first = read(0)
    if count * first.nbytes > budget:
        return Stored(read, count, budget)
    return torch.stack([first, *(read(index) for index in range(1, count))])


class TaughtLabels(NamedTuple):
    """A teacher's labels of a view's cells: classes i64 [h, w], -1 none; confidence [h, w] in [0,
    1]; class_codes [L, C] that features of a label are near; complete: every cell has a label.
    """

    classes: Tensor
    confidence: Tensor
    class_codes: Tensor
    complete: bool = False


class Window(NamedTuple):
    """A part of a photo, in its pixels."""

    top: int
    left: int
    height: int
    width: int

    def of(self, image: Tensor) -> Tensor:
        """The part of an image [H, W, ...]."""
        return image[self.top : self.top + self.height, self.left : self.left + self.width]


@dataclass
class Views:
    """Training views. images [V, H, W, 3] u8; masks [V, H, W] bool or None, both as tensors or
    stored; features: view index -> [h, w, C]; labels: view index -> `TaughtLabels` of these h × w
    cells, None where the teacher has none; depth: view index and factor -> z-depths [H, W] at
    1/factor, scene units, nan where unknown; exposures: [V, 3] stops that photos have more than a
    picture of the scene, or None: all have none.
    """

    names: list[str]
    images: Tensor | Stored
    Ks: Tensor
    viewmats: Tensor
    masks: Tensor | Stored | None = None
    features: Callable[[int], Tensor] | None = None
    labels: Callable[[int], TaughtLabels] | None = None
    depth: Callable[[int, int], Tensor] | None = None
    exposures: Tensor | None = None
    scaled_Ks: dict[int, Tensor] = field(default_factory=dict)  # by factor, on first use

    def to(self, device: str | torch.device) -> Views:
        """The same views on a device: photos, masks and cameras for good, labels for each step
        anew, and features and depth as steps read them, of which DEVICE_BYTES each stay there;
        themselves where they lie there.
        """
        if torch.device(device) == self.Ks.device:
            return self
        features, labels, depth = self.features, self.labels, self.depth
        at_hand: dict[str, Any] = {"features": None, "depth": None}
        if features is not None:
            at_hand["features"] = remembered(lambda index: features(index).to(device), DEVICE_BYTES)
        if depth is not None:
            read = remembered(lambda key: depth(*key).to(device), DEVICE_BYTES)
            at_hand["depth"] = lambda index, factor: read((index, factor))

        def labels_there(index: int) -> TaughtLabels:
            assert labels is not None
            classes, confidence, codes, complete = labels(index)
            return TaughtLabels(
                classes.to(device), confidence.to(device), codes.to(device), complete
            )

        return Views(
            self.names,
            self.images.to(device),
            self.Ks.to(device),
            self.viewmats.to(device),
            None if self.masks is None else self.masks.to(device),
            at_hand["features"],
            None if labels is None else labels_there,
            at_hand["depth"],
            None if self.exposures is None else self.exposures.to(device),
        )

    def camera(self, index: int, factor: int, window: Window | None = None) -> View:
        """The view's camera at 1/factor of its resolution, or of a window of the whole photo."""
        height, width = self.images.shape[1] // factor, self.images.shape[2] // factor
        K = self._Ks_at(factor)[index]
        if window is not None:
            width, height = window.width, window.height
            K = torch.cat(
                [K[:, :2], K[:, 2:] - K.new_tensor([window.left, window.top, 0])[:, None]], 1
            )
        return View(K, self.viewmats[index], width, height)

    def _Ks_at(self, factor: int) -> Tensor:
        """Intrinsics [V, 3, 3] at 1/factor."""
        if factor not in self.scaled_Ks:
            height, width = self.images.shape[1:3]
            sizes = width // factor / width, height // factor / height, 1.0
            self.scaled_Ks[factor] = self.Ks * self.Ks.new_tensor(sizes)[:, None]
        return self.scaled_Ks[factor]

    def photo(self, index: int, window: Window | None = None) -> tuple[Tensor, Tensor | None]:
        """The photo u8 [H, W, 3] of a view or window, and its mask bool [H, W]; None: all count."""
        image, mask = self.images[index], None if self.masks is None else self.masks[index]
        if window is None:
            return image, mask
        return window.of(image), None if mask is None else window.of(mask)


def reduced(photo: Tensor, mask: Tensor | None, factor: int) -> tuple[Tensor, Tensor | None]:
    """Colours [H, W, 3] in [0, 1] and mask [H, W] of a photo u8 at 1/factor; a reduced pixel counts
    where all of its pixels do.
    """
    image = photo.float() / 255
    if factor > 1:
        image = (
            torch.nn.functional.avg_pool2d(image.permute(2, 0, 1), factor)
            .permute(1, 2, 0)
            .contiguous()
        )
        if mask is not None:
            mask = -torch.nn.functional.max_pool2d(-mask[None].float(), factor)[0] > 0.5
    return image, mask
