"""Sweeps: many trainings (scenes x settings x seeds), run by Dask, with one table of results."""
