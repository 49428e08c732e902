"""Small trainings by the gradient, and its directional derivatives against finite differences."""

import pytest
import torch

SMALL = {
    "n_envs": 32,
    "n_steps": 16,
    "horizon": 8,
    "first_share": 1.0,
    "gradient_steps": 4,
    "lookahead_steps": 0,
    "features": ["products"],
}


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
