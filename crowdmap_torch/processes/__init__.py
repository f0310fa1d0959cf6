"""The process and its like: workers that die with it, signals that end it, streams that nobody reads."""
