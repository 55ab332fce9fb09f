"""What `physx check` expects of a material."""


def _has_mass(subject):
    density = subject.make().density
    assert density > 0, f"its density is {density} kg/m³"


CHECKS = {"has mass": _has_mass}
