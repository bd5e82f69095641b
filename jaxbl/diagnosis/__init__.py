"""From a log to the effect that a model lacks, the model with it, and the proof on held-out data."""
