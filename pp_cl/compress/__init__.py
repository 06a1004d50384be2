"""Makes trained models smaller and faster within a stated loss of quality."""
