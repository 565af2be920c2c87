"""Search for black ink in PDF documents, and its removal."""
