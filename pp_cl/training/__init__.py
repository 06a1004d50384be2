"""What changes the parameters."""
