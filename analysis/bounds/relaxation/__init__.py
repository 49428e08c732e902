"""Pieces of the bound by information relaxation: `analysis.bounds.information_relaxation` puts them together."""
