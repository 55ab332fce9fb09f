"""``physx weigh``: print the mass of a volume of a material."""

from physx_core import plugins
from physx_core.cli import show


def run(words):
    reference, volume = words
    material = plugins.resolve("material", plugins.complete_reference("material", reference))()
    show(f"{material.density * float(volume):g} kg")
