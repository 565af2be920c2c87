"""Web page of a live session, and its server."""
