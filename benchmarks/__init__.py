"""Speed against the tools people use now: `python -m benchmarks`."""
