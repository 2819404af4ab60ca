"""`python -m evercal`: the command line where no script folder is on the path."""

import sys

if not sys.flags.safe_path:
    del sys.path[0]  # the current folder, which may hold any file

from evercal.cli import main

sys.exit(main())
