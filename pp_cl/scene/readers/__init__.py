"""Readers of scenes: one module a format, and what they share in common.py and frame.py."""
