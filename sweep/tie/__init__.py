"""The link of real tables: files in, a labelled solution or a plan of observations out."""
