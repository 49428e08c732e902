"""Directional derivatives of a cost by the weights of a policy, by the gradient and by finite differences."""

import pytest
import torch


def check_gradient(roads, network):
    """The gradient of the cost of a stretch against the difference of its costs, along a random direction."""
    weights = list(network.parameters())
    direction = [torch.randn_like(weight) for weight in weights]
    cost = roads.cost(network, 2, 8, 0.0)
    slope = sum((a * b).sum() for a, b in zip(torch.autograd.grad(cost, weights), direction, strict=True))
    moved = []
    for sign in (1, -1):
        with torch.no_grad():
            for weight, along in zip(weights, direction, strict=True):
                weight += sign * 0.015 * along
            moved.append(float(roads.cost(network, 2, 8, 0.0)))
            for weight, along in zip(weights, direction, strict=True):
                weight -= sign * 0.015 * along
    assert (moved[0] - moved[1]) / 0.03 == pytest.approx(float(slope), rel=0.03, abs=2e-3)
