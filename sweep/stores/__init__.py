"""Where results live: ledger, dataset, lock, repair; a folder or a bucket."""
