"""The command ``roadgym``, also ``python -m roadgym``: it stands where no other distribution can take its place."""

from __future__ import annotations

import sys

from .installation import InstallationError, check_package


def main() -> int:
    """Run the command line, if `analysis` and `agents` are those of roadgym; returns the exit code."""
    try:
        check_package("analysis")
        check_package("agents")
        from agents.cli import main as run

        return run()
    except InstallationError as error:
        print(f"roadgym: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:  # before a command has begun, or once it is over: a command says itself what it leaves
        print("roadgym: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
