"""Detection of magnets: matched filter and maximum-likelihood fit of dipoles to one pass."""
