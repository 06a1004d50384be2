"""Readers of scenes: one module per format; common.py and frame.py hold their shared functions."""
