"""Tasks as files, and answers to them, of ``locatk advise``."""
