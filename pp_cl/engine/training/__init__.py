"""The parts of a training step after rendering: losses, optimiser, pruning, schedules, EMA; and
checkpoints and the memory plan.
"""
