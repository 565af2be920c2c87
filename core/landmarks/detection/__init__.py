"""Detection of landmarks: hypotheses from the fit of the field model to each visit."""
