"""Detection of dots and of the lattice on which they are printed."""
