"""The published algorithm of the magnetic landmarks, for comparison."""
