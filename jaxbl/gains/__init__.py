"""Which gains, and which theory to trust: verification of the conditions, tuning, pilot runs, accuracy laws."""
