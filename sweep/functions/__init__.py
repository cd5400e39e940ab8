"""Plain Python functions as experiments: parameters from the signature, outputs from a declaration or the first
result.
"""
