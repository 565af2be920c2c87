"""Sessions: MCAP files of observations, solutions and truth."""
