"""Lets `python -m pp_cl` run the command line `pp-cl`."""

import sys

from pp_cl.cli import program

sys.exit(program())
