"""What a run or a scene is, in numbers."""
