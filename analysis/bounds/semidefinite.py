"""Semidefinite programs over sums of squares, by a primal-dual interior-point method.

    maximise f'u   subject to   c_k - F_k u = sum over blocks of w diag(B Q_k B'),   Q_k positive semidefinite,

where a polynomial is told by its values at as many points as it has coefficients: c_k are the values of a given one, the
columns of F_k of others, the rows of B values of a basis, and w, of either sign, those of a multiplier. In values the
constraints are of rank one, so that the matrix of Newton's equations is an elementwise product of two matrices (J. Löfberg and
P. Parrilo, "From coefficients to samples: a new approach to SOS optimization", CDC 2004). Direction of Helmberg, Kojima and
Monteiro, predictor and corrector of Mehrotra, as in B. Borchers, "CSDP, a C library for semidefinite programming", Optimization
Methods and Software 11, 1999. Nothing that is found here need be trusted: what proves a bound is checked afterwards.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from ..checks import FloatArray

MOST = 60  # iterations
GAP = 3e-5  # of the optimum, relative, at which it is near enough
MISFIT = 1e-8  # likewise of the constraints, over the largest of c
SHARE = 0.95  # of the way to the cone's edge
EASED = 4 * np.finfo(float).eps  # by which diagonals are raised, without which a last step's factor fails

Matrices = Sequence[FloatArray]  # of each block, shape (constraints, size, size)
Direction = tuple[FloatArray, FloatArray, list[FloatArray], list[FloatArray]]  # of u, y, q and z


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Program:
    """The program above.

    Attributes:
        target: c, shape (constraints, points).
        columns: F, shape (constraints, points, unknowns).
        gain: f, shape (unknowns,).
        bases: B of each block, shape (points, size).
        multipliers: w of each block, shape (points,).
    """

    target: FloatArray
    columns: FloatArray
    gain: FloatArray
    bases: Sequence[FloatArray]
    multipliers: Sequence[FloatArray]

    def squares(self, grams: Matrices) -> FloatArray:
        """Values of the sums of squares of these Gram matrices, shape (constraints, points)."""
        parts = [w * np.einsum("us,kus->ku", b, b @ q) for b, w, q in zip(self.bases, self.multipliers, grams, strict=True)]
        return np.asarray(sum(parts))

    def moments(self, measure: FloatArray) -> list[FloatArray]:
        """The adjoint of `squares`: a matrix for each block, of weights of the points, shape (constraints, points)."""
        return [(b.T * (w * measure)[:, None, :]) @ b for b, w in zip(self.bases, self.multipliers, strict=True)]


def solve(program: Program, report: Callable[[int, int], None] | None = None) -> tuple[FloatArray, list[FloatArray]]:
    """(u, the matrices Q of each block, shape (constraints, size, size)), as near to the optimum as rounding lets them be.

    Args:
        program: of the order of 1, with well-conditioned bases.
        report: called as ``report(done, total)``.
    """
    count, points, unknowns = program.columns.shape
    sizes = [basis.shape[1] for basis in program.bases]
    q = [np.tile(np.eye(size), (count, 1, 1)) for size in sizes]
    z = [matrix.copy() for matrix in q]
    u, y = np.zeros(unknowns), np.zeros((count, points))
    dimension, largest = count * sum(sizes), 1 + float(np.abs(program.target).max())
    for turn in range(MOST):
        if report is not None:
            report(turn, MOST)
        misfit = program.target - program.columns @ u - program.squares(q)
        lack = program.gain - np.einsum("kun,ku->n", program.columns, y)
        apart = [moment - matrix for moment, matrix in zip(program.moments(y), z, strict=True)]
        optimum, ceiling = float(program.gain @ u), float(np.sum(program.target * y))
        if abs(ceiling - optimum) <= GAP * abs(optimum) and np.abs(misfit).max() <= MISFIT * largest:
            break
        product = _inner(q, z) / dimension
        try:
            newton = _Newton(program, q, z)
            du, dy, dq, dz = newton.direction([-matrix for matrix in q], misfit, lack, apart)
            far = newton.reach(dq, dz, 1.0)
            left = _inner(_moved(q, dq, far[0]), _moved(z, dz, far[1])) / dimension / product
            centre = float(np.clip(left, 0, 1)) ** (2 if min(far) < 0.2 else 3)
            goals = [
                centre * product * b - a - _symmetric(da @ db @ b)
                for a, b, da, db in zip(q, newton.inverse, dq, dz, strict=True)
            ]
            du, dy, dq, dz = newton.refined(goals, misfit, lack, apart)
            far = newton.reach(dq, dz, SHARE)
        except np.linalg.LinAlgError:  # at the end of what double precision can do
            break
        q, u = _moved(q, dq, far[0]), u + far[0] * du
        z, y = _moved(z, dz, far[1]), y + far[1] * dy
    if report is not None:
        report(MOST, MOST)
    return u, q


class _Newton:
    """Newton's equations at an iterate.

    Raises:
        LinAlgError: rounding is too large for them.
    """

    def __init__(self, program: Program, q: Matrices, z: Matrices) -> None:
        from scipy.linalg import cho_factor, solve_triangular

        self._program, self._q = program, q
        self._roots = [_inverse_root(matrix) for matrix in q], [_inverse_root(matrix) for matrix in z]
        self.inverse = [np.swapaxes(root, -1, -2) @ root for root in self._roots[1]]
        count, points, _ = program.columns.shape
        whole = np.zeros((count, points, points))
        for b, w, left, right in zip(program.bases, program.multipliers, q, self.inverse, strict=True):
            whole += np.outer(w, w) * (b @ left @ b.T) * (b @ right @ b.T)
        whole[:, range(points), range(points)] *= 1 + EASED
        self._factors = [cho_factor(matrix, lower=True, check_finite=False) for matrix in whole]
        halves = [
            solve_triangular(factor[0], column, lower=True, check_finite=False)
            for factor, column in zip(self._factors, program.columns, strict=True)
        ]
        self._rest = cho_factor(np.sum([half.T @ half for half in halves], axis=0), check_finite=False)

    def direction(self, goals: Matrices, right: FloatArray, lack: FloatArray, apart: Matrices) -> Direction:
        """(du, dy, dq, dz) with squares(dq) + columns du = right, columns' dy = lack and dz - moments(dy) = apart.

        The fourth equation is dq + q dz z^-1 = goal, of which only the symmetric part is kept.
        """
        from scipy.linalg import cho_solve

        program = self._program
        rows = program.squares(self._followed(goals, apart)) - right
        du = cho_solve(self._rest, lack - np.einsum("kun,ku->n", program.columns, self._solved(rows)), check_finite=False)
        dy = self._solved(rows + program.columns @ du)
        dz = _sums(program.moments(dy), apart)
        return du, dy, self._followed(goals, dz), dz

    def refined(self, goals: Matrices, right: FloatArray, lack: FloatArray, apart: Matrices) -> Direction:
        """`direction`, and once more to what rounding has left of its right sides."""
        du, dy, dq, dz = self.direction(goals, right, lack, apart)
        program, nothing = self._program, [np.zeros_like(matrix) for matrix in self._q]
        right = right - program.squares(dq) - program.columns @ du
        more = self.direction(nothing, right, lack - np.einsum("kun,ku->n", program.columns, dy), nothing)
        return du + more[0], dy + more[1], _sums(dq, more[2]), _sums(dz, more[3])

    def reach(self, dq: Matrices, dz: Matrices, share: float) -> tuple[float, float]:
        """How far to go along both, at most 1: ``share`` of the way to where a matrix ceases to be positive definite."""
        found = []
        for roots, steps in zip(self._roots, (dq, dz), strict=True):
            moved = [_symmetric(root @ step @ np.swapaxes(root, -1, -2)) for root, step in zip(roots, steps, strict=True)]
            least = min(float(np.linalg.eigvalsh(each).min()) for each in moved)
            found.append(1.0 if least >= -share else -share / least)
        return found[0], found[1]

    def _followed(self, goals: Matrices, dz: Matrices) -> list[FloatArray]:
        return [goal - _symmetric(a @ d @ b) for goal, a, d, b in zip(goals, self._q, dz, self.inverse, strict=True)]

    def _solved(self, rows: FloatArray) -> FloatArray:
        from scipy.linalg import cho_solve

        return np.stack([cho_solve(factor, row, check_finite=False) for factor, row in zip(self._factors, rows, strict=True)])


def _symmetric(matrices: FloatArray) -> FloatArray:
    return (matrices + np.swapaxes(matrices, -1, -2)) / 2


def _inner(left: Matrices, right: Matrices) -> float:
    return float(sum(np.sum(a * b) for a, b in zip(left, right, strict=True)))


def _sums(left: Matrices, right: Matrices) -> list[FloatArray]:
    return [a + b for a, b in zip(left, right, strict=True)]


def _moved(matrices: Matrices, steps: Matrices, far: float) -> list[FloatArray]:
    return [_symmetric(matrix + far * step) for matrix, step in zip(matrices, steps, strict=True)]


def _inverse_root(matrices: FloatArray) -> FloatArray:
    """The inverses of Cholesky's factors."""
    return np.linalg.inv(np.linalg.cholesky(matrices))
