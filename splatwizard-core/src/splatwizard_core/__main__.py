"""`python -m splatwizard_core` is `sw`."""

import sys

from splatwizard_core.cli.main import main

sys.exit(main())
