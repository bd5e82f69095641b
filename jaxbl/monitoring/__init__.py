"""What a drive's observers say of its wear while it runs: gap, stiffness and friction over time, and an alarm."""
