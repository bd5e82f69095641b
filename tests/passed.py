"""What `diagnosis.json` holds of a model against which the held-out data have nothing to say."""

PASSED = {
    "level": 0.01,
    "failed": [],
    "far": {},
    "remainder": False,
    "worse": False,
    "little": False,
    "contradicting": False,
    "doubtful": False,
    "weak": [],
    "untested": {},
}
