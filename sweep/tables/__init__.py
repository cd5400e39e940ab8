"""Tables in files: every format read into one, columns as numbers, and files as values of parameters."""
