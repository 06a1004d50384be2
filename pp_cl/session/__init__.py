"""A training in the folder of a run: begun or resumed, measured, planned and stored."""
