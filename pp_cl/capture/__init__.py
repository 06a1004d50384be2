"""From photographs or a film of an object to a scene: cameras, box and masks."""
