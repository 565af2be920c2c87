"""Raw signals of each system in a report: one module per system."""
