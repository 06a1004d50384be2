"""Smaller and faster models out of trained ones, within a stated loss."""
