"""Maps of landmarks: the floor, its as-built record, and windows of neighbouring landmarks."""
