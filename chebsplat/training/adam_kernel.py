"""A step of Adam, compiled."""

import math

from chebsplat.kernels.jit import kernel


@kernel
def update(first, last, values, gradient, mean, square, size, scale, tiny, share1, share2):
    """Moments and values [first, last) after one gradient; all are flat float32.

    Args: size: the rate over the mean's bias; scale: of the mean square's root, undoing its bias;
      share1 and share2: 1 − β, the new gradient's part in either moment.
    """
    values, gradient = values[first:last], gradient[first:last]
    mean, square = mean[first:last], square[first:last]
    for i in range(len(values)):
        g = gradient[i]
        mean[i] += share1 * (g - mean[i])
        square[i] += share2 * (g * g - square[i])
        values[i] -= size * mean[i] / (math.sqrt(square[i]) * scale + tiny)
