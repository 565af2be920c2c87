"""What ``import locatk`` offers: sessions, solutions, and functions on them."""
