"""What is timed: a function for each side of each row, called in a process of its own by `benchmarks.side`."""
