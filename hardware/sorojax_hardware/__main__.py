"""`python -m sorojax_hardware`, the same as `sorojax-bench`."""

import sys

from sorojax_hardware.cli import main

sys.exit(main())
