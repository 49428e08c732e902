"""Lower bounds of the cost of every controller."""

from .bound import PROVED, SOLVED, STATISTICAL, LowerBound

__all__ = ["PROVED", "SOLVED", "STATISTICAL", "LowerBound"]
