"""A study for other systems: what runs in real time beside a drive as code, lowered from the step that is simulated; the
drive as a model for other simulators."""

from .targets import TARGETS, Export, export
