"""Scenes: photographs with cameras and masks, and the visual hull where the points start."""
