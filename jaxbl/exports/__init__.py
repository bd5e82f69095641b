"""Code and models for other systems, from a study."""
