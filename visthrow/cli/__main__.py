"""Entry point of ``python -m visthrow.cli``."""

import sys

from visthrow.cli import main

sys.exit(main())
