"""Design of tags: accuracy bound, advice and bill of materials."""
