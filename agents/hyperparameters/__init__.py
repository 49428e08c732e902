"""Hyperparameters: one YAML file an algorithm, and some for a kind of task, taken by their names."""
