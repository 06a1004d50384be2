"""Photographs, cameras, the visual hull."""
