"""The locatk serial protocol."""
