"""`python -m sorojax` is the command `sorojax`."""

import sys

from sorojax.cli.main import main

sys.exit(main())
