"""`python -m evercal.cli`."""

import sys

from evercal.cli import main

sys.exit(main())
