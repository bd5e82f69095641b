"""The workload as others run it, written by hand in each one's own way: what the package's speed is measured against."""
