"""One self-contained HTML page about results; it knows of no experiment."""
