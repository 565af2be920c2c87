"""Pure computation on numpy arrays, without files, terminals or clocks."""
