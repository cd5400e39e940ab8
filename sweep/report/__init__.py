"""Results and runs as HTML pages."""
