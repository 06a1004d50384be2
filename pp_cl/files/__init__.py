"""Reads and writes files: checkpoints, images, films, the folder of a run; written atomically and
checked when read.
"""
