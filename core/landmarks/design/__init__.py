"""Design of landmarks and maps: analysis, map search, proof and bill of materials."""
