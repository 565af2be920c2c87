"""Recovery of damaged sessions."""
