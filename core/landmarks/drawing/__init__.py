"""Installation pack of a floor: plan, templates at true size, lists."""
