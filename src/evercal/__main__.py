"""`python -m evercal`: the command line where no script folder is on the path."""

import sys

from evercal.cli import main

sys.exit(main())
