"""Speed compared with other tools: `python -m benchmarks`."""
