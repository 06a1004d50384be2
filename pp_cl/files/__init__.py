"""Files of a run and images, written atomically, read without trust."""
