"""Two plain classifiers. Their one setting is chosen on a quarter of the training split, for every feature alike."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

RIDGES = (1e-4, 1e-3, 1e-2, 1e-1)
NEIGHBORS = (1.0, 5.0, 15.0)
Classifier = Callable[[np.ndarray], np.ndarray]


def standardizer(x: np.ndarray) -> Classifier:
    """To mean 0 and deviation 1; columns that only rounding changes become 0, else a shift would blow them up."""
    middle, spread = x.mean(0), x.std(0)
    size = np.abs(x).max(0)
    varies = spread > np.maximum(1e-9 * size, 1e-12 * size.max())
    return lambda new: np.where(varies, (new - middle) / np.where(varies, spread, 1.0), 0.0)


def logistic(x: np.ndarray, labels: np.ndarray, ridge: float) -> Classifier:
    """Multinomial logistic regression of standardised features, with a penalty ridge / 2 ‖weights‖²."""
    n_classes, standard = int(labels.max()) + 1, standardizer(x)
    inputs, targets = torch.from_numpy(standard(x)).double(), torch.from_numpy(labels)
    weights = torch.zeros(x.shape[1], n_classes, dtype=torch.float64, requires_grad=True)
    bias = torch.zeros(n_classes, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([weights, bias], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        value = torch.nn.functional.cross_entropy(inputs @ weights + bias, targets) + ridge / 2 * weights.square().sum()
        value.backward()
        return value

    optimizer.step(loss)  # type: ignore[no-untyped-call]
    w, b = weights.detach().numpy(), bias.detach().numpy()
    return lambda new: (standard(new) @ w + b).argmax(1)


def nearest(x: np.ndarray, labels: np.ndarray, k: float) -> Classifier:
    """Vote of the k nearest training samples, in standardised features; ties go to the nearer class."""
    from scipy.spatial import cKDTree

    standard = standardizer(x)
    tree = cKDTree(standard(x))

    def classify(new: np.ndarray) -> np.ndarray:
        _, index = tree.query(standard(new), int(k))
        found = labels[index.reshape(len(new), int(k))]
        votes = (found[:, :, None] == np.arange(labels.max() + 1)).astype(float)
        return (votes * (1 - 1e-3 * np.arange(int(k)))[None, :, None]).sum(1).argmax(1)

    return classify


def fit(kind: str, x: np.ndarray, labels: np.ndarray, rng: np.random.Generator) -> Classifier:
    """`linear` or `knn`, with the setting that is best on a quarter of the given samples held out."""
    make, settings = {"linear": (logistic, RIDGES), "knn": (nearest, NEIGHBORS)}[kind]
    order = rng.permutation(len(x))
    held, kept = np.split(order, [len(x) // 4])
    scores = [accuracy(make(x[kept], labels[kept], s), x[held], labels[held]) for s in settings]
    return make(x, labels, settings[int(np.argmax(scores))])


def accuracy(classifier: Classifier, x: np.ndarray, labels: np.ndarray) -> float:
    """Share of samples classified right, in percent."""
    return 100 * float((classifier(x) == labels).mean())
