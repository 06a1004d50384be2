"""From points to blended features, and back to gradients."""
