"""The plugin ``workshop``."""

from physx_core.plugins import hookimpl


@hookimpl
def physx_formats():
    return {"columns": "physx_workshop.columns:COLUMNS"}


@hookimpl
def physx_protocols():
    return {"datagrams": "physx_workshop.datagrams:Datagrams"}


@hookimpl
def physx_trial_executors():
    return {"patient": "physx_workshop.patient:Patient"}


@hookimpl
def physx_materials():
    return {
        "steel": "physx_workshop.materials:Steel",
        "antimatter": "physx_workshop.materials:Antimatter",
    }
