"""Errors of this package that the command line must know without loading the learning libraries."""


class AgentError(ValueError):
    """A folder that does not hold a usable agent, or that cannot be written."""
