"""Which effects are laws of the same torque, and which numbers they may have."""

from jaxbl.diagnosis.candidates import is_finer_law
from jaxbl.drive.effects import EFFECTS


def test_finer_laws_are_those_of_the_torque_of_their_special_case():
    """Another cause that holds the special case at some numbers is none: gravity, a disturbance, a second mass."""
    general = {name.partition(".")[2]: is_finer_law(name) for name in EFFECTS if EFFECTS[name].special_cases}
    assert {kind for kind, finer in general.items() if finer} == {
        "stribeck_friction",
        "presliding_friction",
        "drifting_friction",
        "cogging_harmonics",
    }
    assert {kind for kind, finer in general.items() if not finer} == {"gravity", "periodic_disturbance", "flexibility"}
