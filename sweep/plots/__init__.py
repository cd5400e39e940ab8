"""Pictures of results: a function takes a Dataset and draws on Axes; matplotlib is imported here and nowhere else."""
