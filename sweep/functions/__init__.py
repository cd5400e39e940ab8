"""Plain Python functions as experiments: parameters from signatures, outputs from declarations or first results."""
