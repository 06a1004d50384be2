"""Makes trained models smaller within a stated loss of quality."""
