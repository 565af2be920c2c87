"""The published algorithm of Polaris, for comparison."""
