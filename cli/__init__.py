"""The `locatk` command: parses, calls, prints. No mathematics."""
