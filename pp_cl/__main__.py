"""`python -m pp_cl` is `pp-cl`."""

import sys

from pp_cl.cli import program

sys.exit(program())
