"""The optimiser of networks that are trained by gradients through the plant."""

import numpy as np
import pytest
import torch

from agents.muon import Muon, orthogonal


@pytest.mark.parametrize("shape", [(64, 64), (64, 17), (2, 64)])
def test_singular_vectors_stay_and_singular_values_become_one(shape):
    left, _, right = torch.linalg.svd(torch.randn(shape, generator=torch.Generator().manual_seed(1)), full_matrices=False)
    matrix = left @ torch.diag(torch.logspace(0, -1.5, min(shape))) @ right
    found = left.T @ orthogonal(1e-3 * matrix) @ right.T
    assert torch.all((found.diagonal() > 0.6) & (found.diagonal() < 1.2))  # where the iteration leaves them
    assert float((found - torch.diag(found.diagonal())).abs().max()) < 1e-4


def test_a_closure_gives_the_gradients_and_the_loss():
    weights = torch.nn.Parameter(torch.ones(3))
    optimiser = Muon([weights], lr=0.1)

    def closure():
        optimiser.zero_grad()
        loss = weights.square().sum()
        loss.backward()
        return loss

    assert optimiser.step(closure).item() == 3.0
    np.testing.assert_allclose(weights.detach(), 0.9, atol=1e-6)


def test_vectors_and_single_rows_move_as_by_adam():
    generator = torch.Generator().manual_seed(2)
    starts = [torch.randn(5, generator=generator), torch.randn(1, 7, generator=generator)]
    ours, adams = ([torch.nn.Parameter(start.clone()) for start in starts] for _ in range(2))
    muon, adam = Muon(ours, lr=0.01), torch.optim.Adam(adams, lr=0.01)
    for _ in range(20):
        for own, other in zip(ours, adams, strict=True):
            own.grad = torch.randn(own.shape, generator=generator)
            other.grad = own.grad.clone()
        muon.step()
        adam.step()
    for own, other in zip(ours, adams, strict=True):
        np.testing.assert_allclose(own.detach(), other.detach(), atol=1e-6)


def test_matrices_move_by_the_learning_rate_whatever_the_gradient_s_size_and_follow_their_momentum():
    matrix = torch.nn.Parameter(torch.zeros(8, 4))
    optimiser = Muon([matrix], lr=0.1, matrix_lr=0.5)
    gradient = torch.randn(8, 4, generator=torch.Generator().manual_seed(3))
    matrix.grad = 1e-6 * gradient
    optimiser.step()
    first = matrix.detach().clone()
    values = torch.linalg.svdvals(first) / (0.05 * 2**0.5)
    assert torch.all((values > 0.6) & (values < 1.2))
    matrix.grad = torch.zeros(8, 4)  # what is left is momentum, in the same direction
    optimiser.step()
    torch.testing.assert_close(matrix.detach() - first, first, rtol=1e-3, atol=1e-6)
    other = torch.randn(8, 4, generator=torch.Generator().manual_seed(5)) * 1e-6
    matrix.grad, before = other, matrix.detach().clone()
    optimiser.step()
    momentum = 0.95 * (0.95 * 0.05e-6 * gradient) + 0.05 * other  # and a look ahead, as Nesterov has it
    expected = -0.05 * 2**0.5 * orthogonal(0.05 * other + 0.95 * momentum)
    torch.testing.assert_close(matrix.detach() - before, expected, rtol=1e-3, atol=1e-6)
