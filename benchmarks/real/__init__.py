"""Recordings of real machines: what they are, two other tools on them, and how all are compared."""
