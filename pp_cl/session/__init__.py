"""Begins, resumes, measures, plans and stores a training in the folder of a run."""
