"""The CPU's Adam takes the steps of torch's, the same bits on any number of threads."""

import pytest
import torch
from thread_counts import assert_same_bits

from chebsplat.training.adam import KernelAdam, adam


def course(kind):
    """After some steps: gradients span many sizes, and one parameter has none at first."""
    generator = torch.Generator().manual_seed(0)
    parameters = [torch.randn(shape, generator=generator) for shape in ((500, 3), (7,), (40, 5, 3))]
    sizes = [10.0 ** torch.randint(-12, 6, p.shape, generator=generator) for p in parameters]
    for parameter in parameters:
        parameter.requires_grad_()
    optimizer = kind(
        [{"params": parameters[:2], "lr": 0.01}, {"params": parameters[2:], "lr": 1.0}]
    )
    for step in range(50):
        optimizer.zero_grad(set_to_none=True)
        for at, parameter in enumerate(parameters):
            if at != 1 or step > 5:
                parameter.grad = sizes[at] * torch.randn(parameter.shape, generator=generator)
        optimizer.step()
    moments = [optimizer.state[p][name] for p in parameters for name in ("exp_avg", "exp_avg_sq")]
    return [p.detach() for p in parameters], moments, optimizer


def test_steps_and_moments_are_those_of_torch():
    ours, theirs = course(adam), course(lambda groups: torch.optim.Adam(groups, eps=1e-15))
    assert isinstance(ours[2], KernelAdam)
    for found, expected in zip(ours[0], theirs[0], strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)  # after 50 steps of 1
    for found, expected in zip(ours[1], theirs[1], strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=0)


def test_the_same_bits_on_any_number_of_threads():
    def compute():
        values, moments, _ = course(adam)
        return [tensor.numpy() for tensor in values + moments]

    assert_same_bits(compute)


def test_a_closure_is_refused():
    _, _, optimizer = course(adam)
    with pytest.raises(ValueError, match="closure"):
        optimizer.step(lambda: 0)
