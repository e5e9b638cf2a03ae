"""The functions that are timed, one for each side of each row; `benchmarks.side` calls them in their own process."""
