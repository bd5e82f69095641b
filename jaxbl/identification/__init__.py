"""What runs offline on a log: smoother, trajectory fits, intervals. See design.md, section 2."""
