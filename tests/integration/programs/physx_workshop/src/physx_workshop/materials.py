"""Materials."""


class Material:
    """What a body is made of.

    Attributes:
        density: In kg/m³.
    """

    density = 0.0


class Steel(Material):
    density = 7850.0


class Antimatter(Material):
    density = -1.0
