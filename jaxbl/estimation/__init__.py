"""From a log to numbers with intervals: smoother, trajectory fits, intervals, and the command's result."""
