"""Tables in files: reading every format, columns as numbers, and files as values of parameters."""
