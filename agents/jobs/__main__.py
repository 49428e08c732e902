"""``python -m agents.jobs FOLDER``: a worker of the jobs in a folder, as long as somebody waits for jobs there."""

from __future__ import annotations

import sys

from .worker import main

main(*sys.argv[1:])
