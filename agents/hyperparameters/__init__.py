"""Hyperparameters, one YAML file an algorithm."""
