"""Detection of landmarks: the field model fitted to one visit, and its explanations."""
