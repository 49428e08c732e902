"""Muon, an optimiser for small networks whose gradients have little noise: matrices move by orthogonal steps.

The momentum of a matrix of weights is replaced by the orthogonal matrix nearest to it, found by Newton and Schulz's iteration:
so all its directions move alike, also those of small gradients. What is no matrix moves by Adam's rule.

Source: K. Jordan et al., "Muon: An optimizer for hidden layers in neural networks", 2024,
https://kellerjordan.github.io/posts/muon. Here in single precision, on any version of PyTorch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from roadgym.installation import needs

with needs("train"):
    import torch
    from torch import Tensor

ITERATIONS, COEFFICIENTS = 5, (3.4445, -4.7750, 2.0315)  # these bring singular values from 0.002 to 1 to within 0.68 and 1.21


def orthogonal(matrix: Tensor) -> Tensor:
    """Nearly the orthogonal matrix that is nearest to ``matrix``: with its singular vectors, and singular values of about 1."""
    linear, cubic, quintic = COEFFICIENTS
    wide = matrix.T if matrix.shape[0] > matrix.shape[1] else matrix
    wide = wide / (wide.norm() + 1e-12)
    for _ in range(ITERATIONS):
        square = wide @ wide.T
        wide = torch.addmm(wide, torch.addmm(square, square, square, beta=cubic, alpha=quintic), wide, beta=linear)
    return wide.T if matrix.shape[0] > matrix.shape[1] else wide


class Muon(torch.optim.Optimizer):
    """Orthogonal steps for matrices of more than one row, Adam's for everything else.

    Args:
        params: of the network.
        lr: learning rate of Adam's steps.
        matrix_lr: learning rate of orthogonal steps over ``lr``, so that a schedule moves both.
        momentum: of matrices, with Nesterov's look ahead.
        betas, eps: of Adam.
    """

    def __init__(
        self,
        params: Iterable[Tensor] | Iterable[dict[str, Any]],
        lr: float = 3e-3,
        matrix_lr: float = 20 / 3,
        momentum: float = 0.95,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        super().__init__(params, {"lr": lr, "matrix_lr": matrix_lr, "momentum": momentum, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """One step down the gradients, those of a ``closure`` if there is one; what it gives."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for weights in group["params"]:
                if weights.grad is None:
                    continue
                state, gradient = self.state[weights], weights.grad
                is_matrix = weights.ndim == 2 and len(weights) > 1
                if not state:
                    state["mean"] = torch.zeros_like(weights)
                    if not is_matrix:
                        state.update(steps=0, square=torch.zeros_like(weights))
                mean = state["mean"]
                if is_matrix:
                    mean.lerp_(gradient, 1 - group["momentum"])
                    ahead = torch.lerp(gradient, mean, group["momentum"])
                    size = max(1, weights.shape[0] / weights.shape[1]) ** 0.5
                    weights.add_(orthogonal(ahead), alpha=-group["lr"] * group["matrix_lr"] * size)
                else:
                    (first, second), square = group["betas"], state["square"]
                    state["steps"] += 1
                    mean.lerp_(gradient, 1 - first)
                    square.lerp_(gradient.square(), 1 - second)
                    scale = (square / (1 - second ** state["steps"])).sqrt_().add_(group["eps"])
                    weights.addcdiv_(mean, scale, value=-group["lr"] / (1 - first ** state["steps"]))
        return loss
