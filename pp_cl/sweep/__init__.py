"""Many trainings with one table: scenes x settings x seeds, shared out by Dask."""
