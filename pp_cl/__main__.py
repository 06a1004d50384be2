"""`python -m pp_cl` is `pp-cl`."""

import sys

from pp_cl.cli import main

sys.exit(main())
