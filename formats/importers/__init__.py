"""Published recordings of others, read into the project's own arrays; one module a format."""
