"""The published algorithm of the dot pattern, for comparison."""
