"""Detection of magnets: maximum-likelihood fit of dipoles to one pass of the array."""
