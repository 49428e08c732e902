"""``python -m agents.cli``."""

import sys

from . import main

sys.exit(main())
